import re
from pathlib import Path

import pytest

from pp_cl.settings import Config, every_setting
from tools.docs_tables import BLOCK

ROOT = Path(__file__).parents[2]
DOCUMENTS = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
PATH = re.compile(r"`((?:pp_cl|pp_studio|cl|tests|tools|docs)/[\w./]+)`")
CARD = re.compile(r"\b([ABHLV]\d{2,3}|[RG]TX|GeForce|Radeon|Instinct|MI\d{3})\b")
FIGURE = re.compile(r"\d (ms|s|seconds|minutes|dB|times)\b|^\|.*\| *[\d.,]+ *\|", re.MULTILINE)
PUBLISHED = "RTX 5090, by 3dgrut's README"
PLACEHOLDER = re.compile(r"\bW/|\b(?:test_)?x[._]")  # placeholders such as cl/W/x.cl and x_forward
FILE = re.compile(r"`((?:\w+/)*\w+\.(?:py|cl|h))`")
PLACES = ("", "cl", "pp_cl", "pp_cl/engine", "pp_studio")  # a page's paths start in one of these
FUNCTION = re.compile(r"`(?:\w+\.)*(\w+)\([^`\n]*\)`")
NAME = re.compile(r"`(?:\w+\.)*(\w*_\w*|[A-Z]\w+)`")
OF_THE_CODE = ("CONTRIBUTING", "architecture", "conventions")  # the other pages contain formulas


def named_files(text: str, folder: Path) -> list[Path]:
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text)
    paths = {p for p in PATH.findall(text) if not PLACEHOLDER.search(p)}
    return [folder / link for link in links] + [ROOT / path for path in sorted(paths)]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.stem)
def test_named_files_exist(path):
    files = named_files(path.read_text("utf-8"), path.parent)
    if not (ROOT / ".github").exists():  # .github is missing from the unpacked source archive
        lines = (ROOT / "MANIFEST.in").read_text("utf-8").splitlines()
        (left_out,) = (line.split()[1:] for line in lines if line.startswith("exclude "))
        files = [file for file in files if file not in {ROOT / name for name in left_out}]
    assert not [str(file) for file in files if not file.exists()]


def sources() -> list[Path]:
    folders = [ROOT / name for name in ("pp_cl", "pp_studio", "cl", "tools", "tests")]
    kinds = ("*.py", "*.pyi", "*.cl", "*.h")
    return [path for folder in folders for kind in kinds for path in folder.rglob(kind)]


def named_code(text: str, *, with_formulas: bool) -> tuple[set[str], set[str]]:
    """(files, names of functions and, unless the page has formulas, of all else in code style)."""
    names = {*FUNCTION.findall(text), *([] if with_formulas else NAME.findall(text))}
    files = {file for file in FILE.findall(text) if not PLACEHOLDER.search(file)}
    return files, {name for name in names if not PLACEHOLDER.search(name)}


@pytest.mark.parametrize(
    "path", [p for p in DOCUMENTS if p.stem != "CHANGELOG"], ids=lambda p: p.stem
)
def test_named_code_exists(path):
    files, names = named_code(path.read_text("utf-8"), with_formulas=path.stem not in OF_THE_CODE)
    written = " ".join(p.read_text("utf-8") for p in sources() if p != Path(__file__))
    assert not [file for file in files if not any((ROOT / top / file).exists() for top in PLACES)]
    assert not names - set(re.findall(r"\w+", written))


def test_stale_names_are_found():
    text = "`two_splits`, `backward_input()`, `scene/target.cl`, `Gone`; `cl/W/x.cl`, `x_forward`"
    assert named_code(text, with_formulas=False) == (
        {"scene/target.cl"},
        {"two_splits", "backward_input", "Gone"},
    )
    assert named_code("`c_z`, `scan(a)`", with_formulas=True) == (set(), {"scan"})


def test_documents_named_in_the_code_exist():
    named = {w for p in sources() for w in re.findall(r"\bdocs/\w+\.md", p.read_text("utf-8"))}
    assert named
    assert not [name for name in named if not (ROOT / name).exists()]


def test_the_readme_names_every_document():
    linked = {path.resolve() for path in named_files((ROOT / "README.md").read_text("utf-8"), ROOT)}
    assert {path for path in DOCUMENTS if path.name != "README.md"} <= linked


def test_links_into_a_page_name_one_of_its_headings():
    broken = [
        f"{path.name}: {page}#{anchor}"
        for path in DOCUMENTS
        for page, anchor in re.findall(r"\]\(([^)#:]*)#([^)]*)\)", path.read_text("utf-8"))
        if anchor not in anchors(path.parent / page if page else path)
    ]
    assert not broken


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"(?m)^#+ (.*)$", page.read_text("utf-8"))
    return {re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in headings}


@pytest.mark.parametrize(
    "path", [p for p in DOCUMENTS if p.stem != "CHANGELOG"], ids=lambda p: p.stem
)
def test_named_settings_exist(path):
    known = {key.partition(".")[0]: vars(section) for key, section, _ in every_setting(Config())}
    words = re.findall(rf"\b({'|'.join(known)})\.(\w+)\b(?!\.)", path.read_text("utf-8"))
    files = {"py", "cl", "md", "json", "h", "txt"}
    assert not [w for w in words if w[1] not in known[w[0]] and w[1] not in files]


def typed_figures(text: str) -> list[str]:
    """Paragraphs with their tables, and list items, that name a GPU and state a figure not written
    by a command.
    """
    paragraphs = re.split(r"\n\n(?!\|)|\n(?=- )", BLOCK.sub("", text).replace(PUBLISHED, ""))
    return [
        paragraph for paragraph in paragraphs if CARD.search(paragraph) and FIGURE.search(paragraph)
    ]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.stem)
def test_no_figure_of_a_gpu_is_typed(path):
    assert not typed_figures(path.read_text("utf-8"))


@pytest.mark.parametrize(
    "text",
    [
        "NVIDIA's H100 and H200 have run it (`full` in 92 seconds).",
        "Small trainings wait for the H200's host, 4 to 5 ms a step.",
        "On an NVIDIA H100 it is 3 times as fast.",
        "One NVIDIA H200, at commit 15af55e9.\n\n| scene | PSNR |\n|---|---|\n| demo | 37.51 |",
    ],
)
def test_typed_figures_of_a_gpu_are_found(text):
    written = "Of the card:\n\n<!-- table: kinds -->\nH200, 92 s\n\n<!-- end table -->"
    assert typed_figures(f"## GPUs\n\n{written}\n\n{text}\n\n{written}") == [text]
