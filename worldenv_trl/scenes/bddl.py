"""Task files in LIBERO's dialect of BDDL (arXiv 2306.03310): what is on the table, where, and what is asked for.

A file is one s-expression, ``(define (problem CLASS) (:domain robosuite) (:language ...) (:regions ...)
(:fixtures ...) (:objects ...) (:obj_of_interest ...) (:init ...) (:goal ...))``; case does not matter and ``;`` starts
a comment. The dialect was read off LIBERO's 130 files; the parser is our own.
"""

from __future__ import annotations

import difflib
import hashlib
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

PREDICATES: Mapping[str, tuple[str, int]] = {
    "on": ("On", 2),
    "in": ("In", 2),
    "open": ("Open", 1),
    "close": ("Close", 1),
    "turnon": ("TurnOn", 1),
    "turnoff": ("TurnOff", 1),
}
_BLOCKS = ("domain", "language", "regions", "fixtures", "objects", "obj_of_interest", "init", "goal")
_OPTIONAL = ("obj_of_interest", "regions")
_REGION_PARTS = (":target", ":ranges", ":yaw_rotation", ":rgba")
_TOKEN = re.compile(r"[()]|[^\s()]+")


class BDDLError(ValueError):
    """A task file that cannot be read; the message names file, line and token."""


@dataclass(frozen=True)
class Region:
    """A named place: rectangles on a workspace, or a part of an object or fixture (then without ``ranges``).

    ``ranges`` are ``(x_low, y_low, x_high, y_high)`` in metres, ``yaw`` is ``(low, high)`` in radians.
    """

    name: str
    target: str
    ranges: tuple[tuple[float, float, float, float], ...] = ()
    yaw: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Problem:
    """A parsed task file. Names are lower case; predicates are ``("On", "bowl_1", "plate_1")`` and the like.

    ``regions`` is keyed by ``target_name``, the name that predicates use; ``fixtures`` and ``objects`` map instances to
    categories. ``lines`` says where in the file ``("thing", name)``, ``("region", name)``, ``("init", *predicate)``,
    ``("goal", *predicate)`` and ``("problem", kind)`` stand. ``digest`` is the SHA-256 of what the file says, its words
    and parentheses: comments and white space do not change it.
    """

    kind: str
    language: str
    regions: Mapping[str, Region]
    fixtures: Mapping[str, str]
    objects: Mapping[str, str]
    objects_of_interest: tuple[str, ...]
    init: tuple[tuple[str, ...], ...]
    goal: tuple[tuple[str, ...], ...]
    digest: str = field(default="", compare=False)
    source: str = "<text>"
    lines: Mapping[tuple[str, ...], int] = field(default_factory=dict, compare=False, repr=False)

    def where(self, *key: str) -> str:
        """File, line and token of what ``lines`` calls ``key``, to begin a message with."""
        line = f":{self.lines[key]}" if key in self.lines else ""
        token = key[1] if len(key) == 2 else f"({' '.join(key[1:])})"
        return f"{self.source}{line}: {token!r}"

    def error(self, *key: str, message: str) -> BDDLError:
        """What is wrong with the thing, region or predicate that ``lines`` calls ``key``."""
        return BDDLError(f"{self.where(*key)}: {message}")


def read_bddl(path: str | Path) -> Problem:
    """Reads a task file; raises :class:`BDDLError`, or ``FileNotFoundError`` naming the path."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no task file {path}")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise BDDLError(f"{path}: not a text file ({error.reason} at byte {error.start})") from error
    return parse_bddl(text, str(path))


def parse_bddl(text: str, source: str = "<text>") -> Problem:
    """Parses the text of a task file; ``source`` names it in errors."""
    return _Parser(source).problem(text)


@dataclass(frozen=True)
class _Atom:
    text: str
    line: int

    @property
    def word(self) -> str:
        return self.text.lower()


@dataclass(frozen=True)
class _List:
    items: tuple[_Atom | _List, ...]
    line: int

    @property
    def text(self) -> str:
        return "(" + " ".join(item.text for item in self.items) + ")"


_Node = _Atom | _List


class _Parser:
    def __init__(self, source: str) -> None:
        self.source = source
        self.lines: dict[tuple[str, ...], int] = {}
        self.unknown_targets: dict[str, _Atom] = {}

    def error(self, node: _Node, message: str) -> BDDLError:
        token = node.text if len(node.text) <= 60 else node.text[:57] + "..."
        return BDDLError(f"{self.source}:{node.line}: {token!r}: {message}")

    # ------------------------------------------------------------------------------------------------ structure

    def tree(self, text: str) -> _List:
        stack: list[tuple[list[_Node], int]] = []
        root: _List | None = None
        for token in self._tokens(text):
            if root is not None:
                raise self.error(token, "nothing may follow the closing parenthesis of (define ...)")
            if token.text == "(":
                stack.append(([], token.line))
            elif not stack:
                raise self.error(token, "a task file starts with '(define'")
            elif token.text == ")":
                items, line = stack.pop()
                whole = _List(tuple(items), line)
                if stack:
                    stack[-1][0].append(whole)
                else:
                    root = whole
            else:
                stack[-1][0].append(token)
        if stack:
            items, line = stack[-1]
            opened = _Atom("(" + (items[0].text if items else ""), line)
            raise self.error(opened, "this parenthesis is never closed")
        if root is None:
            raise BDDLError(f"{self.source}: the file is empty")
        return root

    def _tokens(self, text: str) -> Iterator[_Atom]:
        for number, line in enumerate(text.splitlines(), 1):
            for match in _TOKEN.finditer(line.split(";", 1)[0]):
                yield _Atom(match.group(), number)

    def problem(self, text: str) -> Problem:
        root = self.tree(text)
        head, *rest = self._atoms_then_lists(root, "define", 0)
        if not rest or not isinstance(rest[0], _List):
            raise self.error(head, "(define is followed by (problem CLASS)")
        kind = self._atom(self._atoms_then_lists(rest[0], "problem", 1)[1])
        self.lines["problem", kind.word] = kind.line
        blocks = self._blocks(rest[1:])
        missing = [name for name in _BLOCKS if name not in blocks and name not in _OPTIONAL]
        if missing:
            raise self.error(rest[0], f"the block (:{missing[0]} ...) is missing")
        if [item.text.lower() for item in blocks["domain"].items[1:]] != ["robosuite"]:
            raise self.error(blocks["domain"], "the domain must be robosuite")
        language = " ".join(self._atom(item).text for item in blocks["language"].items[1:])
        if not language:
            raise self.error(blocks["language"], "the instruction is empty")

        fixtures = self._instances(blocks["fixtures"], {})
        objects = self._instances(blocks["objects"], fixtures)
        names = {**fixtures, **objects}
        regions = self._regions(blocks.get("regions"), names)
        return Problem(
            kind=kind.word,
            language=language,
            regions=regions,
            fixtures=fixtures,
            objects=objects,
            objects_of_interest=self._of_interest(blocks.get("obj_of_interest"), {**names, **regions}),
            init=tuple(self._predicate("init", item, names, regions) for item in blocks["init"].items[1:]),
            goal=self._goal(blocks["goal"], names, regions),
            digest=hashlib.sha256(root.text.encode()).hexdigest(),
            source=self.source,
            lines=self.lines,
        )

    def _atom(self, node: _Node) -> _Atom:
        if isinstance(node, _List):
            raise self.error(node, "expected a word here, not a list")
        return node

    def _atoms_then_lists(self, node: _List, word: str, arguments: int) -> tuple[_Node, ...]:
        """The items of ``(word argument* ...)``, checked."""
        if not node.items or not isinstance(node.items[0], _Atom) or node.items[0].word != word:
            raise self.error(node, f"expected ({word} ...)")
        if arguments and len(node.items) != 1 + arguments:
            raise self.error(node, f"({word} ...) takes {arguments} argument(s), got {len(node.items) - 1}")
        return node.items

    def _blocks(self, nodes: tuple[_Node, ...] | list[_Node]) -> dict[str, _List]:
        blocks: dict[str, _List] = {}
        for node in nodes:
            if isinstance(node, _Atom) or not node.items:
                raise self.error(node, "expected a block (:name ...)")
            name = self._atom(node.items[0]).word.removeprefix(":")
            if name not in _BLOCKS or not node.items[0].text.startswith(":"):
                raise self.error(node.items[0], f"unknown block{_hint(f':{name}', [f':{known}' for known in _BLOCKS])}")
            if name in blocks:
                raise self.error(node.items[0], f"a second (:{name} ...); the first is on line {blocks[name].line}")
            blocks[name] = node
        return blocks

    # ------------------------------------------------------------------------------------------------ blocks

    def _instances(self, block: _List, taken: Mapping[str, str]) -> dict[str, str]:
        """``a b - category c - other`` to ``{a: category, b: category, c: other}``."""
        instances: dict[str, str] = {}
        waiting: list[_Atom] = []
        items = iter(self._atom(item) for item in block.items[1:])
        for item in items:
            if item.text != "-":
                if item.text.startswith("-") or item.text.endswith("-"):
                    raise self.error(item, "put a space on either side of the dash: 'name - category'")
                if item.word in taken or item.word in instances or any(item.word == other.word for other in waiting):
                    raise self.error(item, "this name is declared twice; if it is a category, write a dash before it")
                waiting.append(item)
                continue
            category = next(items, None)
            if category is None or category.text == "-" or not waiting:
                raise self.error(item, "instances are declared as 'name ... - category'")
            instances |= {name.word: category.word for name in waiting}
            self.lines |= {("thing", name.word): name.line for name in waiting}
            waiting = []
        if waiting:
            rest = " ".join(item.text for item in waiting[1:])
            found = f"; after it stands {rest!r}, without a dash" if rest else ""
            raise self.error(waiting[0], f"this instance has no category: write '{waiting[0].text} - category'{found}")
        return instances

    def _regions(self, block: _List | None, names: Mapping[str, str]) -> dict[str, Region]:
        regions: dict[str, Region] = {}
        for node in () if block is None else block.items[1:]:
            if isinstance(node, _Atom) or not node.items:
                raise self.error(node, "a region is (name (:target ...) (:ranges ...))")
            own = self._atom(node.items[0]).word
            parts: dict[str, _List] = {}
            for part in node.items[1:]:
                if isinstance(part, _Atom) or not part.items:
                    raise self.error(part, "expected (:target ...), (:ranges ...), (:yaw_rotation ...) or (:rgba ...)")
                key = self._atom(part.items[0])
                if key.word not in _REGION_PARTS:
                    known = f"a region knows {', '.join(_REGION_PARTS)}"
                    raise self.error(key, f"{known}{_hint(key.word, _REGION_PARTS, otherwise='')}")
                if key.word in parts:
                    raise self.error(key, f"a second ({key.word} ...); the first is on line {parts[key.word].line}")
                parts[key.word] = part
            if ":target" not in parts:
                raise self.error(node.items[0], "this region has no (:target ...)")
            target = self._atom(self._atoms_then_lists(parts[":target"], ":target", 1)[1])
            full = f"{target.word}_{own}"
            if target.word not in names:
                close = _hint(target.word, names, otherwise="")
                if close:
                    raise self.error(target, f"the target of region {own!r} is not declared{close}")
                self.unknown_targets[own] = target
                continue  # LIBERO's own goal files carry such leftovers; a predicate that names one fails
            if full in regions:
                raise self.error(node.items[0], f"{target.word} has a second region of this name")
            ranges = tuple(self._rectangle(row) for row in self._rows(parts.get(":ranges"), 4))
            self.lines["region", full] = node.items[0].line
            regions[full] = Region(full, target.word, ranges, self._yaw(own, parts.get(":yaw_rotation")))
        return regions

    def _yaw(self, region: str, part: _List | None) -> tuple[float, float]:
        rows = self._rows(part, 2)
        if part is not None and len(rows) > 1:
            raise self.error(part, f"region {region!r} takes one (low high) of :yaw_rotation, got {len(rows)}")
        if not rows:
            return 0.0, 0.0
        (low, high), node = rows[0]
        for value, item in zip((low, high), node.items, strict=True):
            if abs(value) > 2 * math.pi + 1e-3:
                raise self.error(
                    item,
                    f"the :yaw_rotation of region {region!r} is in radians, within 2 pi either way; "
                    f"{value:g} degrees would be {math.radians(value):.4g}",
                )
        if low > high:
            raise self.error(node, f"the :yaw_rotation of region {region!r} is (low high) with low <= high")
        return low, high

    def _rows(self, part: _List | None, width: int) -> list[tuple[list[float], _List]]:
        """``(:key ((a b ...) ...))``: rows of ``width`` numbers, each with its place in the file."""
        if part is None:
            return []
        if len(part.items) != 2 or not isinstance(part.items[1], _List) or not part.items[1].items:
            raise self.error(part, f"expected ({part.items[0].text} ((number ...) ...))")
        rows = []
        for row in part.items[1].items:
            if isinstance(row, _Atom) or len(row.items) != width:
                raise self.error(row, f"expected a list of {width} numbers")
            rows.append(([self._number(item) for item in row.items], row))
        return rows

    def _number(self, node: _Node) -> float:
        atom = self._atom(node)
        try:
            value = float(atom.text)
        except ValueError:
            raise self.error(atom, "expected a number") from None
        if not -1e6 < value < 1e6:
            raise self.error(atom, "expected a finite number")
        return value

    def _rectangle(self, row: tuple[list[float], _List]) -> tuple[float, float, float, float]:
        (x_low, y_low, x_high, y_high), node = row
        if x_low > x_high or y_low > y_high:
            wrong = f"x_low {x_low:g} > x_high {x_high:g}" if x_low > x_high else f"y_low {y_low:g} > y_high {y_high:g}"
            raise self.error(node, f"{wrong}: a range is (x_low y_low x_high y_high) with low <= high")
        return x_low, y_low, x_high, y_high

    def _of_interest(self, block: _List | None, names: Mapping[str, object]) -> tuple[str, ...]:
        items = [] if block is None else [self._atom(item) for item in block.items[1:]]
        for item in items:
            if item.word not in names:
                raise self._unknown(item, names)
        return tuple(item.word for item in items)

    def _goal(self, block: _List, names: Mapping[str, str], regions: Mapping[str, Region]) -> tuple:
        if len(block.items) != 2 or not isinstance(block.items[1], _List) or not block.items[1].items:
            raise self.error(block, "the goal is one predicate, or (And predicate ...)")
        whole = block.items[1]
        conjunction = isinstance(whole.items[0], _Atom) and whole.items[0].word == "and"
        items = whole.items[1:] if conjunction else [whole]
        goal = tuple(self._predicate("goal", item, names, regions) for item in items)
        if not goal:
            raise self.error(whole, "the goal holds no predicate")
        return goal

    def _predicate(
        self, block: str, node: _Node, names: Mapping[str, str], regions: Mapping[str, Region]
    ) -> tuple[str, ...]:
        if isinstance(node, _Atom) or not node.items:
            raise self.error(node, "expected a predicate such as (On bowl_1 plate_1)")
        head = self._atom(node.items[0])
        if head.word not in PREDICATES:
            known = [name for name, _ in PREDICATES.values()]
            close = _hint(head.text, known, otherwise="")
            raise self.error(
                head, f"unknown predicate{close}; known are {', '.join(known)}, joined by one And in the goal"
            )
        name, count = PREDICATES[head.word]
        arguments = [self._atom(item) for item in node.items[1:]]
        if len(arguments) != count:
            raise self.error(node, f"{name} takes {count} argument(s), got {len(arguments)}")
        for argument in arguments:
            if argument.word not in names and argument.word not in regions:
                raise self._unknown(argument, {**names, **regions})
        whole = (name, *(argument.word for argument in arguments))
        self.lines[(block, *whole)] = node.line
        return whole

    def _unknown(self, item: _Atom, names: Mapping[str, object]) -> BDDLError:
        for own, target in self.unknown_targets.items():
            if item.word.endswith(f"_{own}"):
                missing = f"{target.text!r}, the target of region {own!r} on line {target.line}, is not declared"
                return self.error(item, missing)
        close = _hint(item.word, names, otherwise="")
        return self.error(item, f"this is neither a fixture, an object nor a region of this file{close}")


def _hint(word: str, known: Iterable[str], otherwise: str = "known are ") -> str:
    """``": did you mean ...?"``, or what is known if nothing is close and ``otherwise`` says how to begin."""
    known = list(known)
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.7)  # more than a shared "_1"
    if close:
        return f": did you mean {close[0]!r}?"
    return f": {otherwise}{', '.join(known)}" if otherwise else ""
