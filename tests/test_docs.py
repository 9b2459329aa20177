"""The documentation: links, pictures, code in pages, task pages, and lines that the pages point to."""

import re
import sys
from pathlib import Path

import pytest

import casa_sara

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", *DOCS.rglob("*.md")])
sys.path[:0] = [str(ROOT / "tools"), str(DOCS / "extensions")]

import apipages
import sourcepages
import taskpages
from taskxml import read_task

LINK = re.compile(r'!?\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)(?: "([^"]*)")?\)')
TASKS = sorted((ROOT / "xml").glob("*.xml"))
LARGEST_PICTURE = 150_000  # bytes, of a tutorial


def links(page):
    """Return (text, target, title) of the links of a page that lead into the repository, code left out."""
    text = re.sub(r"^```.*?^```|^    .*?$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    return [found for found in LINK.findall(text) if not re.match(r"[a-z]+:|#", found[1])]


def relative(path):
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_links_lead_to_files(page):
    missing = [target for _, target, _ in links(page) if not (page.parent / target.split("#")[0]).exists()]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_links_to_code_name_what_is_there(page):
    for text, target, title in links(page):
        path, name = (page.parent / target).resolve(), text.strip("`")
        if path.suffix == ".py" and sourcepages.is_definition(name, path):
            sourcepages.line_of(path, name, title)


def test_citation_is_of_this_version():
    assert f"\nversion: {casa_sara.__version__}\n" in (ROOT / "CITATION.cff").read_text()


def test_line_of_finds_definitions_and_texts(tmp_path):
    path = tmp_path / "small.py"
    path.write_text("LIMIT = 3\n\n\nclass Box:\n    size: int = 0\n\n"
                    "    def open(self):\n        # Step 2: lift\n        pass\n")
    lines = {name: sourcepages.line_of(path, name) for name in ("LIMIT", "Box", "Box.size", "Box.open")}
    assert lines == {"LIMIT": 1, "Box": 4, "Box.size": 5, "Box.open": 7}
    assert sourcepages.line_of(path, "Box.open", "Step 2") == 8
    for name, text in (("Box.shut", ""), ("Box.open", "LIMIT")):
        with pytest.raises(sourcepages.NotThere):
            sourcepages.line_of(path, name, text)


def test_every_step_of_the_paper_is_in_the_algorithm_page():
    text = (DOCS / "algorithm.md").read_text()
    for step in (5, 6, 7, 8, 9, 13, 17, 18, 19):
        rows = [row for row in text.splitlines()
                if row.startswith("| Step") and re.search(rf"\b{step}\b", row.split("|")[1])]
        assert any(".py" in row for row in rows), f"Step {step}"


def test_every_page_is_in_a_toctree():
    entries = set()
    for page in DOCS.rglob("*.md"):
        for tree in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(), re.DOTALL):
            for line in tree.splitlines():
                if line and not line.startswith(":"):
                    entries |= {path.resolve() for path in page.parent.glob(line + ".md")}
    assert {path for path in DOCS.rglob("*.md")} - entries == {DOCS / "index.md"}


@pytest.mark.parametrize("xml", TASKS, ids=lambda path: path.stem)
def test_task_page_has_every_parameter_with_its_facts(xml):
    task = read_task(xml)
    page = taskpages.task_page(task)
    assert (DOCS / "tasks" / f"{task.name}.md").exists()
    assert [line for line in page.splitlines() if line.startswith("## ")] == [
        "## Description", "## Parameters", "## Returns", "## Examples"]
    for param in task.params:
        entry = page.split(f"({task.name}-{param.name})=\n", 1)[1].split(f"\n({task.name}-", 1)[0]
        assert re.match(rf"####? {param.name}\n", entry)
        assert "**Type** " in entry
        assert f"**Default** {'none' if param.required else f'`{param.default!r}`'}" in entry
        assert all(f"`{value!r}`" in entry for value in param.allowed)
        assert ("**Sub-parameter of**" in entry) == param.subparam
        assert not param.opener or f"(#{task.name}-{param.opener})" in entry
    assert all(f"```python\n{example.code}\n```" in page for example in task.examples)
    targets = set(re.findall(rf"\(#({task.name}-\w+)\)", page))
    assert targets <= {f"{task.name}-{param.name}" for param in task.params}


def test_help_becomes_markdown():
    text = ("Takes '' and *all* of mode='soft' or x_y='z'.\n\n- one\n  more\n- two\n\n"
            "Kept:\n  a.b   first\n    c   second\n\n"
            "Examples: mode='soft'\n          mode='hard'   (very)")
    assert taskpages.as_markdown(text, "small", ["mode"]) == (
        "Takes `''` and \\*all\\* of [`mode='soft'`](#small-mode) or x\\_y='z'.\n\n- one more\n\n- two\n\nKept:\n\n"
        "```text\na.b   first\n  c   second\n```\n\n```python\nmode='soft'\nmode='hard'   (very)\n```")


def test_api_pages_cover_the_package():
    pages = {path.stem for path in (DOCS / "api").glob("*.md")} - {"index"}
    shown = {name for page in pages for name in apipages.modules(page)}
    package = ROOT / "casa_sara"
    public = {".".join(path.relative_to(ROOT).with_suffix("").parts) for path in package.rglob("*.py")
              if not path.stem.startswith("_")}
    tasks = {name for name in public if name.split(".")[1] in ("tasks", "gotasks", "private")}
    assert shown == public - tasks
    assert "casa_sara.solver.adaptive_ppd" in apipages.api_page("solver")


TUTORIALS = sorted((DOCS / "tutorials").glob("*.py"))


@pytest.mark.parametrize("script", TUTORIALS, ids=lambda path: path.stem)
def test_tutorial_is_whole(script):
    """A page, a picture of moderate size, and code in the page that is the script's."""
    page = script.with_suffix(".md")
    text = page.read_text()
    pictures = [target for text, target, _ in links(page) if target.endswith(".png")]
    assert f"../images/{script.stem}.png" in pictures
    for picture in pictures:
        assert (page.parent / picture).stat().st_size < LARGEST_PICTURE, picture
    assert f"python docs/tutorials/{script.name}" in text
    assert f"({script.stem}.md)" in (DOCS / "tutorials" / "index.md").read_text()
    source = [line.strip() for line in script.read_text().splitlines()]
    shown = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert shown, "no code in the page"
    for code in shown:
        lines = [line.strip() for line in code.splitlines()]
        assert any(source[start : start + len(lines)] == lines for start in range(len(source))), code
