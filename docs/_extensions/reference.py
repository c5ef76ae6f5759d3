"""Directives of the reference: public names with their docstrings, the help of commands, the entries of files.

```{public-names} margins        names of malta that come from this package, or those of a module as malta.report
```{commands}                    every command of the program with its help
```{entries} gain                the tables of a file, from its schema
```{requirements}                what a design can be asked for, of any machine or of that of a data file
```{outputs}                     those of every document that a command prints with --json
"""

from __future__ import annotations

import inspect
import os
import re
from typing import TYPE_CHECKING, Any

from docstrings import to_rest
from docutils import nodes
from public import all_names, docstring_of, names_of, summary_of, value_of
from sphinx import addnodes
from sphinx.util.docutils import SphinxDirective
from typer.main import get_command
from typer.testing import CliRunner

import malta
from malta.cli.documents.published import ALL_SCHEMAS, MODELS
from malta.cli.main import app as program
from malta.schemas.files import change_nodes, without_null
from malta.synthesis.design_tables import specification_record
from malta.synthesis.requirements import GENERIC_REQUIREMENTS, requirements_for
from malta.writing import json_text

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.environment import BuildEnvironment

WIDTH = "80"  # columns of a terminal


class PublicNames(SphinxDirective):
    """A table of some public names with their first sentences, and each with its signature and its docstring."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Parse directives of autodoc; a constant has the text below its assignment."""
        lines = ["```{eval-rst}", ".. list-table::", "   :widths: auto", "   :class: summaries", ""]
        names = names_of(self.arguments[0])
        for name in names:
            link = f":py:obj:`{name.removeprefix('malta.')} <{name}>`"
            first = " ".join(to_rest([summary_of(name)], all_names()))
            lines += [f"   * - {link}", f"     - {first}"]
        for name in names:
            lines += ["", *_describe(name)]
        lines += ["```"]
        found: list[nodes.Node] = self.parse_text_to_nodes("\n".join(lines))
        return found


def _describe(name: str) -> list[str]:
    """The directive that documents a public name."""
    value = value_of(name)
    if inspect.isclass(value):
        fields = ", ".join(getattr(value, "_fields", ()))  # of a named tuple, which its text explains
        return [f".. autoclass:: {name}", "   :members:", f"   :exclude-members: {fields}"]
    if inspect.isroutine(value):
        return [f".. autofunction:: {name}"]
    text = to_rest(docstring_of(name).splitlines(), all_names())
    return [f".. py:data:: {name}", "", *(f"   {line}" for line in text)]


class Commands(SphinxDirective):
    """The commands of the program, each with what it prints for --help, and an anchor command-NAME."""

    def run(self) -> list[nodes.Node]:
        """Ask every command for its help, as a terminal of 80 columns shows it."""
        commands: dict[str, Any] = get_command(program).commands  # type: ignore[attr-defined]
        found: list[nodes.Node] = [self._help("malta", "malta", [])]
        found += [self._help(f"malta {name}", f"command-{name}", [name]) for name in commands]
        return found

    def _help(self, title: str, anchor: str, arguments: list[str]) -> nodes.section:
        terminal = {"COLUMNS": WIDTH, "TERMINAL_WIDTH": WIDTH, "NO_COLOR": "1", "TERM": "dumb"}
        shown = CliRunner().invoke(
            program, [*arguments, "--help"], prog_name="malta", env=os.environ | terminal
        )
        section = nodes.section("", nodes.title("", title), names=[anchor])
        section += nodes.literal_block(shown.output, shown.output.strip("\n"), language="text")
        self.state.document.note_explicit_target(section)
        return section


class Entries(SphinxDirective):
    """The tables of a file, from its schema: name, kind, unit and meaning of each entry."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Write the table of the file itself, and a section for each of its tables, in the order of their use."""
        return self.entries(self.arguments[0])

    def entries(self, kind: str) -> list[nodes.Node]:
        """Write the tables of one schema."""
        tables = tables_of(ALL_SCHEMAS[kind]())
        places = {name: place for name, place, _ in tables}
        found: list[nodes.Node] = [self._download(kind)]
        for name, place, table in tables:
            said = [] if not name else [table.get("description", ""), ""]
            inside = self.parse_text_to_nodes("\n".join([*said, *_rows(table, kind, places)]))
            if not name:
                found += inside
                continue
            section = nodes.section("", nodes.title("", place), *inside, names=[f"{kind}-{name}".lower()])
            self.state.document.note_explicit_target(section)
            found.append(section)
        return found

    def _download(self, kind: str) -> nodes.paragraph:
        """A link to the schema, which `publish_schemas` writes."""
        file = "../" * self.env.docname.count("/") + f"schemas/{kind}.json"
        link = nodes.reference("", f"schemas/{kind}.json", refuri=file, internal=False)
        return nodes.paragraph("", "", nodes.Text("As a JSON schema: "), link, nodes.Text("."))


class Outputs(Entries):
    """The documents that commands print, each in a section."""

    required_arguments = 0

    def run(self) -> list[nodes.Node]:
        """Write a section for each document, under the command that its description names."""
        found: list[nodes.Node] = []
        for name in MODELS:
            command = re.search(r"`([^`]+)`", str(ALL_SCHEMAS[name]().get("description")))
            words = name if command is None else command[1]
            title = nodes.title("", "", nodes.literal("", words))
            section = nodes.section("", title, *self.entries(name), names=[name])
            self.state.document.note_explicit_target(section)
            found.append(section)
        return found


class Requirements(SphinxDirective):
    """What a design of a machine can be asked for: the keys of [specification].

    The argument is a data file, of which the machine's own requirements are listed; without it, those of any machine.
    """

    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Write a table of them, as of other entries."""
        wanted = {requirement.name: requirement for requirement in GENERIC_REQUIREMENTS}
        if self.arguments:
            known = requirements_for(malta.plant_of(malta.read(self.arguments[0])))
            wanted = {name: one for name, one in known.items() if wanted.get(name) is not one}
        table = change_nodes(specification_record(wanted.values()).model_json_schema(), without_null)
        table["required"] = [*table["properties"]]  # each of them may be left out, which is not said of each
        places = {name: place for name, place, _ in tables_of(ALL_SCHEMAS["design"]())}
        found: list[nodes.Node] = self.parse_text_to_nodes("\n".join(_rows(table, "design", places)))
        return found


def _rows(table: dict[str, Any], file: str, places: dict[str, str]) -> list[str]:
    """The entries of a table as rows in Markdown."""
    rows = ["| entry | kind | meaning |", "|---|---|---|"]
    for key, entry in table["properties"].items():
        kind = [_kind(entry, file, places), entry.get("unit", "").removeprefix("1")]
        kind += [] if key in table.get("required", []) else ["optional"]
        meaning = re.sub(r"(?<![`\w])--[a-z]+", r"`\g<0>`", entry.get("description", ""))
        cells = [f"`{key}`", ", ".join(filter(None, kind)), meaning]
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return rows


def tables_of(whole: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    """List the tables of a file in the order of reading: name in the schema, place in the file, and its schema.

    A table that stands in several places is called by its name; NAME stands for a key of the writer's choice.
    """
    places: dict[str, list[str]] = {}

    def visit(node: dict[str, Any], place: str) -> None:
        for inner in node.get("anyOf", ()):
            visit(inner, place)
        for key, inner in node.get("properties", {}).items():
            visit(inner, f"{place}.{key}".lstrip("."))
        if isinstance(node.get("additionalProperties"), dict):
            visit(node["additionalProperties"], f"{place}.NAME")
        if "items" in node:
            visit(node["items"], f"{place}[]")
        name = str(node.get("$ref", "")).rpartition("/")[2]
        if name and name not in UNLISTED:
            known = name in places
            places.setdefault(name, []).append(place)
            if not known:
                visit(whole["$defs"][name], place)

    visit(whole, "")
    called = {name: found[0] if len({*found}) == 1 else name for name, found in places.items()}
    return [("", "", whole), *((name, called[name], whole["$defs"][name]) for name in places)]


UNLISTED = ("Published", "Columns")  # explained in words


def _kind(entry: dict[str, Any], file: str, places: dict[str, str]) -> str:
    """What stands behind a key, in words; tables are links to their entries."""
    if "anyOf" in entry:
        kinds = dict.fromkeys(_kind(inner, file, places) for inner in entry["anyOf"])
        named = [kind for kind in kinds if kind]
        return (" or " if len(named) < 3 else ", ").join(named)
    if "$ref" in entry:
        name = entry["$ref"].rpartition("/")[2]
        return "" if name in UNLISTED else f"[{places[name]}](#{file}-{name.lower()})"
    if "const" in entry or "enum" in entry:
        return " or ".join(f"`{value}`" for value in entry.get("enum", [entry.get("const")]))
    kind = str(entry.get("type", "any"))
    if kind == "array":
        items = (
            entry["items"] if "items" in entry else entry["prefixItems"][0]
        )  # of a tuple, whose entries are alike
        rows = items.get("type") == "array"
        inner = "" if rows or items.get("type") == "number" else f" of {_kind(items, file, places)}"
        size = f", {entry['shape']}" if "shape" in entry else ""
        return f"{'matrix' if rows else 'list'}{inner}{size}"
    if kind == "object":
        free = entry.get("additionalProperties")
        return f"by name: {_kind(free, file, places)}" if isinstance(free, dict) else "table"
    words = {"string": "text", "boolean": "true or false", "integer": "whole number", "null": "null"}
    return words.get(kind, kind) + _range(entry)


def _range(entry: dict[str, Any]) -> str:
    limits = {"exclusiveMinimum": "above", "minimum": "from", "maximum": "to", "exclusiveMaximum": "below"}
    return "".join(f" {word} {entry[key]:g}" for key, word in limits.items() if key in entry)


def convert(_app: Sphinx, _what: str, _name: str, _value: object, _options: object, lines: list[str]) -> None:
    """Make reStructuredText of a docstring, in place, as autodoc asks for it."""
    lines[:] = to_rest(lines, all_names())


def resolve(_app: Sphinx, _env: BuildEnvironment, node: Any, text: Any) -> Any:
    """Links of types in signatures: to the public name, if there is one; other types are text.

    A link of a page is not resolved here: where its target is missing, the build says so.
    """
    if node.get("refdomain") != "py" or not _is_of_signature(node):
        return None
    last = node["reftarget"].rpartition(".")[2]
    if f"malta.{last}" in all_names() and node["reftarget"] != f"malta.{last}":
        node["reftarget"] = f"malta.{last}"
        domain = _env.get_domain("py")
        return domain.resolve_xref(_env, node["refdoc"], _app.builder, "obj", node["reftarget"], node, text)
    return text


def _is_of_signature(node: Any) -> bool:
    while node is not None:
        if isinstance(node, addnodes.desc_signature):
            return True
        node = node.parent
    return False


def publish_schemas(app: Sphinx, error: Exception | None) -> None:
    """Write the schemas of files and outputs beside the pages, for editors and programs."""
    if error is not None or app.builder.format != "html":
        return
    folder = app.outdir / "schemas"
    folder.mkdir(exist_ok=True)
    for name, make in ALL_SCHEMAS.items():
        (folder / f"{name}.json").write_text(json_text(make()) + "\n", encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register directives, docstrings and links."""
    app.add_directive("public-names", PublicNames)
    app.add_directive("commands", Commands)
    app.add_directive("entries", Entries)
    app.add_directive("outputs", Outputs)
    app.add_directive("requirements", Requirements)
    app.connect("autodoc-process-docstring", convert)
    app.connect("missing-reference", resolve)
    app.connect("build-finished", publish_schemas)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
