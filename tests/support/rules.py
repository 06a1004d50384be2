"""Rules of the Python sources. Each check takes a parsed module and its path below the root, and
returns what breaks the rule.
"""

import ast
import io
import re
import tokenize

# What a wing (or a module at the door) may import: its own floor and those below it.
FLOORS = [
    ("errors", "reference", "presets", "settings"),
    ("config", "files", "device"),
    ("scene", "raster", "layers"),
    ("network", "metrics"),
    ("training", "model", "render"),
    ("train", "trained", "run_config"),
    ("run", "evaluate", "film", "export", "view", "info", "shape"),
    ("bench", "selftest", "sweep", "compress"),
    ("commands",),
    ("cli", "__init__", "__main__"),
]
FLOOR = {wing: floor for floor, wings in enumerate(FLOORS) for wing in wings}

FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)

# Who may write to an attribute of another object, and why.
SHARED = {
    "pp_cl/cli.py": {
        "warnings.showwarning": "the hook that Python has for this",
    }
}
# Who below commands/ may print, and why.
PRINTERS = {"pp_cl/device/device.py": "PP_DEBUG's tables"}


def wing_of(path):
    """pp_cl/raster/blend.py -> raster; pp_cl/train.py -> train."""
    return path.removeprefix("pp_cl/").removesuffix(".py").partition("/")[0]


def imported(tree):
    """Modules of pp_cl that a module imports, as dotted names: of `from a import b` a.b."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return [name for name in names if name.startswith("pp_cl.")]


def imports_from_above(tree, path):
    """A wing imports its own floor and lower ones only."""
    wing = wing_of(path)
    above = {name.split(".")[1] for name in imported(tree)}
    above = {other for other in above if FLOOR.get(other, -1) > FLOOR[wing]}
    return [f"{wing} imports {other}" for other in sorted(above)]


def prints(tree, path):
    """Only commands and the command line print."""
    if FLOOR[wing_of(path)] >= FLOOR["commands"] or path in PRINTERS:
        return []
    nodes = (n.func if isinstance(n, ast.Call) else n for n in ast.walk(tree))
    words = {ast.unparse(n) for n in nodes if isinstance(n, ast.Name | ast.Attribute)}
    return sorted(words & {"print", "sys.stdout", "sys.stderr"})


def foreign_writes(tree, path):
    """State has one owner: an attribute is set through `self` or `cls`, or by a method."""
    targets = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.ctx, ast.Store | ast.Del)
        and not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls"))
    ]
    found = {ast.unparse(node) for node in targets}
    return sorted(name for name in found if name not in SHARED.get(path, ()))


def untyped_functions(tree, path):
    """Public functions and methods have types on all parameters and on the result."""
    owners = [n for n in ast.walk(tree) if isinstance(n, ast.ClassDef) and n.name[0] != "_"]
    functions = [n for owner in [tree, *owners] for n in owner.body if isinstance(n, FUNCTIONS)]
    found = []
    for node in (n for n in functions if n.name[0] != "_" or n.name == "__init__"):
        parameters = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
        typed = all(a.annotation or a.arg in ("self", "cls") for a in parameters)
        if not typed or not (node.returns or node.name == "__init__"):
            found.append(f"{node.name} has no types")
    return found


def lambdas_in_dicts(tree, path):
    """A dict holds no lambdas: they hide parameters."""
    dicts = (node for node in ast.walk(tree) if isinstance(node, ast.Dict))
    return [
        f"line {value.lineno}: lambda in a dict"
        for node in dicts
        for value in node.values
        if isinstance(value, ast.Lambda)
    ]


def circles(trees):
    """Modules of {path: tree} that import themselves through others, as one chain each."""
    modules = {p.removesuffix(".py").replace("/", "."): imported(t) for p, t in trees.items()}
    graph = {
        name: {m for i in imports for m in (i, i.rpartition(".")[0]) if m in modules and m != name}
        for name, imports in modules.items()
    }
    found, done = [], set()

    def visit(name, chain):
        if name in chain:
            found.append(" -> ".join([*chain[chain.index(name) :], name]))
        elif name not in done:
            for other in sorted(graph[name]):
                visit(other, [*chain, name])
            done.add(name)

    for name in sorted(graph):
        visit(name, [])
    return found


def retired_words(glossary):
    """{word: what to use instead} of the table below the heading "Retired" of the glossary."""
    _, _, section = re.split(r"(?mi)^(#+ .*retired.*)$", glossary, maxsplit=1)
    section = re.split(r"(?m)^#", section, maxsplit=1)[0]
    rows = [row.strip("|").split("|") for row in section.splitlines() if row.startswith("|")]
    rows = [(word.strip(" `"), instead.strip()) for word, instead, *_ in rows[2:]]
    return {word.replace(" ", "_"): instead for word, instead in rows}


def identifiers(source, suffix):
    """The identifiers of a Python (".py") or OpenCL source; comments and strings have none."""
    if suffix == ".py":
        tokens = tokenize.generate_tokens(io.StringIO(source).readline)
        return {token.string for token in tokens if token.type == tokenize.NAME}
    return set(re.findall(r"\b[A-Za-z_]\w*", re.sub(r"//.*", "", source)))
