"""Hooks of MkDocs: pages that are not in docs/, and links that lead out of it.

The site needs no other server: a file of the repository that a page links becomes part of it.
"""

import os
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PACKAGES = {"envs_jax": ROOT / "envs_jax", "hmasd_jax": ROOT / "src" / "hmasd_jax"}
PAGES = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
}
"""Pages outside docs/, and where the site has them."""
LANGUAGES = {".py": "python", ".toml": "toml", ".md": "markdown", ".yml": "yaml"}
"""Files that become a page, because browsers would not show them as they are."""
LINK = re.compile(r"\]\((?!\w+:|#)([^)\s#]+)(#[^)\s]*)?\)")
CODE = re.compile(r"^ *```.*?^ *```$", re.DOTALL | re.MULTILINE)


def on_config(config: MkDocsConfig) -> None:
    """Add the API reference to the navigation."""
    assert config.nav is not None
    config.nav.append({"API": [{name: f"reference/{name}.md"} for name in _rooms()]})


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the API reference, the pages outside docs/, and what any page links."""
    for name in _rooms():
        _add(files, config, f"reference/{name}.md", content=f"::: {name}\n")
    for name, uri in PAGES.items():
        _add(files, config, uri, abs_src_path=str(ROOT / name))
    for page in [*(ROOT / name for name in PAGES), *sorted(DOCS.rglob("*.md"))]:
        for link in LINK.finditer(CODE.sub("", page.read_text())):
            _add_linked(files, config, (page.parent / link[1]).resolve())


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point links to where the site has their targets, and hide notes for the tests."""
    markdown = re.sub(r"^```python needs \w+$", "```python", markdown, flags=re.MULTILINE)
    source = page.file.abs_src_path
    if source is None:
        return markdown
    here = os.path.dirname(page.file.src_uri)

    def point(link: re.Match) -> str:
        uri, anchor = _place((Path(source).parent / link[1]).resolve())
        return f"]({os.path.relpath(uri, here or '.')}{link[2] or anchor})"

    return LINK.sub(point, markdown)


def _rooms() -> list[str]:
    """Return the dotted names with a page of the reference: packages, their rooms and modules."""
    names = []
    for package, folder in PACKAGES.items():
        parts = [p for p in folder.iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()]
        names += [f"{package}.{part.stem}" for part in sorted(parts) if part.stem[0] != "_"]
    return names


def _place(path: Path) -> tuple[str, str]:
    """Return where the site has a file or folder of the repository, and the anchor on that page."""
    for package, folder in PACKAGES.items():
        if path.is_relative_to(folder) and path.suffix == ".py":
            parts = path.relative_to(folder).with_suffix("").parts
            name = ".".join((package, *parts)).removesuffix(".__init__")
            return f"reference/{package}.{parts[0]}.md", f"#{name}"
    name = path.relative_to(ROOT).as_posix()
    if path.is_relative_to(DOCS):
        return path.relative_to(DOCS).as_posix(), ""
    if name in PAGES:
        return PAGES[name], ""
    if path.is_dir():
        return f"repository/{name}/index.md", ""
    return f"repository/{name}{'.md' * (path.suffix in LANGUAGES)}", ""


def _add_linked(files: Files, config: MkDocsConfig, path: Path) -> None:
    """Add a file or folder of the repository that the site does not have."""
    uri, _ = _place(path)
    if not uri.startswith("repository/") or files.get_file_from_path(uri):
        return
    title = f"# {path.relative_to(ROOT)}\n\n"
    if path.is_dir():
        entries = [p for p in sorted(path.iterdir()) if p.name[0] not in "._"]
        links = [os.path.relpath(_place(entry)[0], os.path.dirname(uri)) for entry in entries]
        lines = [f"- [{entry.name}]({link})" for entry, link in zip(entries, links)]
        _add(files, config, uri, content=title + "\n".join(lines))
        for entry in entries:
            _add_linked(files, config, entry)
    elif path.suffix in LANGUAGES:
        fence = "`" * 4
        text = f"{fence}{LANGUAGES[path.suffix]}\n{path.read_text()}{fence}\n"
        _add(files, config, uri, content=title + text)
    else:
        _add(files, config, uri, abs_src_path=str(path))


def _add(files: Files, config: MkDocsConfig, uri: str, **source: str) -> None:
    file = File.generated(config, uri, **source)
    if uri.startswith("repository/"):
        file.inclusion = InclusionLevel.NOT_IN_NAV
    files.append(file)
