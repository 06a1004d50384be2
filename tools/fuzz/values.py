"""Values, texts and JSON out of joint: what someone else's program, disk or hand may have left."""

import json
import math
import string
from random import Random
from typing import Any

NUMBERS = (
    *(0, -1, 1, 2, 3, 0.5, -0.0, 1e-3, 1e-7, 1e-30, 1e-45, 5e-324, 1e5, 1e9, 1e15, 1e20, 9.99e29),
    *(
        -1e29,
        1e30,
        1e38,
        3.5e38,
        1e300,
        -1e300,
        2**31 - 1,
        2**31,
        2**32,
        2**53 + 1,
        2**63,
        -(2**63),
    ),
    *(math.pi, 16, 100, 65535, 10**25),
)
TEXTS = (
    *("", " ", "x", "nan", "inf", "-inf", "1e400", "0x10", "1_000", "٣", "1.5", "true", "null"),
    *(
        "../..",
        "/",
        "/etc/passwd",
        ".",
        "~",
        "a/b",
        "loop",
        "a\nb",
        "a\x1b[31mb",
        "a\0b",
        "ä",
        "😀",
    ),
    *("%s", "{0}", "$HOME", "'", '"', "-1", "1,2,3", "1e5", "x" * 300, "x" * 100_000, "a\u2028b"),
)
# tokens of JSON that json.dumps does not write of such values
RAW = (
    *("NaN", "Infinity", "-Infinity", "1e400", "-1e400", "1" + "0" * 400, "9" * 5000, "-0", "1E5"),
    *('"\\ud800"', '"\\u0000"', '"\\udcff"', "[" * 60 + "]" * 60, "[" * 900 + "]" * 900),
    *("[" * 5000 + "]" * 5000, '{"a":' * 400 + "1" + "}" * 400, "{}", "[]", "[[]]", "null", "true"),
    *("false", '"a\\nb\\u001b[31m"', '[["a"]]', "[null]", "[1,2,3]", "[true,true,true]", "1.0"),
)
KEYS = ("", "a", "format", "__class__", "__proto__", "a\nb", "x" * 5000, "ä", "file_path", "step")
MARK = "@@RAW{}@@"


class Raw:
    """A token that goes into JSON as it is."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __repr__(self) -> str:
        return self.text


def dumps(value: Any) -> bytes:
    """JSON of a value that may hold Raw tokens, in UTF-8 that may hold lone surrogates."""
    raws = []

    def plain(part):
        if isinstance(part, Raw):
            raws.append(part.text)
            return MARK.format(len(raws) - 1)
        if isinstance(part, dict):
            return {key: plain(inner) for key, inner in part.items()}
        return [plain(inner) for inner in part] if isinstance(part, list) else part

    text = json.dumps(plain(value))
    for index, raw in enumerate(raws):
        text = text.replace(f'"{MARK.format(index)}"', raw)
    return text.encode("utf-8", "surrogatepass")


def odd(rng: Random) -> Any:
    """A value that hardly fits anywhere."""
    return rng.choice(
        [Raw(rng.choice(RAW)), rng.choice(NUMBERS), rng.choice(NUMBERS), rng.choice(TEXTS)]
    )


def odd_text(rng: Random) -> str:
    """The same as a word of a command line or of a line of text."""
    if rng.random() < 0.4:
        return rng.choice(TEXTS)
    if rng.random() < 0.5:
        return repr(rng.choice(NUMBERS))
    if rng.random() < 0.5:
        return ",".join(repr(rng.choice(NUMBERS)) for _ in range(rng.randrange(1, 7)))
    letters = string.printable + "äß€\u0660\u202e"
    return "".join(rng.choice(letters) for _ in range(rng.randrange(1, 12)))


def brief(value: Any) -> str:
    """A value for the label of an input."""
    return repr(value)[:40].encode("ascii", "backslashreplace").decode()


def places(value: Any, path: tuple = ()) -> list[tuple]:
    """The path to every dict, list and leaf inside a value of JSON, the value's own first."""
    found = [path]
    if isinstance(value, (dict, list)):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            found += places(part, (*path, key))
    return found


def _owner(value, path):
    for key in path[:-1]:
        value = value[key]
    return value


def changed_json(rng: Random, value: Any, keys: tuple[str, ...] = ()) -> tuple[str, Any]:
    """(label, the value with one to three changes; it is itself changed). keys: that may be added,
    beside odd ones.
    """
    labels = []
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        path = rng.choice(places(value)[1:] or [()])
        if not path:
            return "all", odd(rng)
        owner, key = _owner(value, path), path[-1]
        kind = rng.choice(["odd"] * 6 + ["drop", "add", "add", "swap", "wrap", "double", "scale"])
        labels.append(f"{kind} {'.'.join(map(str, path))[:60]}")
        labels[-1] += _change(rng, kind, owner, key, keys=keys)
    return "; ".join(labels), value


def _change(rng, kind, owner, key, *, keys):
    """Change one place; returns the rest of its label."""
    old = owner[key]
    if kind == "odd":
        owner[key] = odd(rng)
    elif kind == "drop":
        del owner[key]
        return ""
    elif kind == "add":
        target = old if isinstance(old, (dict, list)) else owner
        if isinstance(target, dict):
            added = rng.choice([*keys, *keys, *KEYS])
            target[added] = odd(rng)
            return f" {brief(added)}: {brief(target[added])}"
        target.insert(rng.randrange(len(target) + 1), odd(rng))
    elif kind == "swap":
        others = list(owner) if isinstance(owner, dict) else range(len(owner))
        other = rng.choice(list(others))
        owner[key], owner[other] = owner[other], old
    elif kind == "wrap":
        owner[key] = rng.choice([[old], {"a": old}, [old, old], str(old)[:200], [[old]]])
    elif kind == "double" and isinstance(owner, list):
        owner.insert(key, old)
    elif isinstance(old, (int, float)) and not isinstance(old, bool):
        factor = rng.choice([-1, 0, 2, 1e-9, 1e9, 1 + 1e-6, 1e30])
        owner[key] = old * factor if abs(old) < 1e100 else factor
    return f" = {brief(owner[key])}"


def changed_text(rng: Random, data: bytes) -> tuple[str, bytes]:
    """(label, bytes) of a text whose lines or words are changed, or whose coding is another."""
    text = data.decode("utf-8", "replace")
    lines = text.split("\n")
    at = rng.randrange(len(lines))
    kind = rng.choice(
        ["word"] * 8 + ["line gone", "line twice", "lines swapped", "line", "coding", "wrapped"]
    )
    if kind == "word":
        words = lines[at].split(" ")
        place = rng.randrange(len(words))
        words[place] = odd_text(rng)
        lines[at] = " ".join(words)
        kind += f" {at}.{place} = {brief(words[place])}"
    elif kind == "line gone":
        del lines[at]
    elif kind == "line twice":
        lines.insert(at, lines[at])
    elif kind == "lines swapped":
        other = rng.randrange(len(lines))
        lines[at], lines[other] = lines[other], lines[at]
    elif kind == "line":
        lines.insert(at, odd_text(rng))
    elif kind == "coding":
        code = rng.choice(["utf-16", "utf-32", "utf-16-le", "utf-8-sig", "utf-7", "cp037"])
        return f"coding {code}", text.encode(code, "replace")
    else:
        return kind, rng.choice(
            [b"\xef\xbb\xbf" + data, data * 2, b" " * 10**6 + data, b"// x\n" + data]
        )
    return kind, "\n".join(lines).encode("utf-8", "surrogatepass")
