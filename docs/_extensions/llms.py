"""The file llms.txt beside the pages (https://llmstxt.org): every page with its title, its address and one line."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from docutils import nodes
from sphinx import addnodes

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.environment import BuildEnvironment

SENTENCE = re.compile(r".+?[.?!](?= |$)")


class Entry(NamedTuple):
    """A page as the list names it: title, address relative to the list, and its first sentence."""

    title: str
    address: str
    line: str


def llms_text(project: str, summary: str, groups: dict[str, list[Entry]]) -> str:
    """Write the list: the project, what it is, and the pages of each group."""
    parts = [f"# {project}", f"> {summary}"]
    for name, entries in groups.items():
        rows = [f"- [{e.title}]({e.address}){f': {e.line}' if e.line else ''}" for e in entries]
        parts.append("\n".join([f"## {name}", "", *rows]))
    return "\n\n".join(parts) + "\n"


def first_sentence(document: nodes.document) -> str:
    """The first sentence of a page's first paragraph; empty for a page that has none."""
    for paragraph in document.findall(nodes.paragraph):
        if isinstance(paragraph.parent, nodes.section):
            text = " ".join(paragraph.astext().split())
            found = SENTENCE.match(text)
            return found[0] if found else text.rstrip(":")
    return ""


def groups_of(env: BuildEnvironment) -> dict[str, list[Entry]]:
    """The pages below each caption of the first page, in reading order."""
    root = env.config.root_doc
    captions = env.get_doctree(root).findall(addnodes.toctree)
    return {
        str(toctree["caption"]): [
            Entry(env.titles[page].astext(), f"{page}.html", first_sentence(env.get_doctree(page)))
            for start in toctree["includefiles"]
            for page in _below(env, start)
        ]
        for toctree in captions
    }


def _below(env: BuildEnvironment, page: str) -> list[str]:
    """A page and those of its own tables of contents, depth first."""
    return [page, *(deep for child in env.toctree_includes.get(page, []) for deep in _below(env, child))]


def publish(app: Sphinx, error: Exception | None) -> None:
    """Write llms.txt once the pages are written."""
    if error is None and app.builder.format == "html":
        summary = first_sentence(app.env.get_doctree(app.config.root_doc))
        text = llms_text(app.config.project, summary, groups_of(app.env))
        Path(app.outdir, "llms.txt").write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Write the list at the end."""
    app.connect("build-finished", publish)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
