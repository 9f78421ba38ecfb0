"""Small faults for a Python module: each mutant is its source with one expression or statement replaced.

    arithmetic     a + b -> a - b, a * b -> a / b, a ** b -> a * b, a << b -> a >> b, a & b -> a | b; also `+=`
    comparison     < -> <=, > -> >=, == -> !=, is -> is not, in -> not in, and back
    condition      if a -> if not a, also of `a if c else b` and of comprehensions
    boolean        a and b -> a or b, not a -> a, -a -> a
    constant       True -> False, 3 -> 4, 0.5 -> 1.0, "a" -> "XXa"; those of default arguments are among them
    keyword        f(a, key=b) -> f(a): whatever is called takes its default
    statement      a call for its effect, `raise`, an assignment to a part of something or to a name that has a value
                   already: left out

Annotations, decorators, docstrings, imports and names of types are left alone.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator
from dataclasses import dataclass

MARK = "_MUTANT_IS_LOADED"
"""A name that every mutant defines, so that it can be told from the module that it stands for."""

_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd, ast.BitXor: ast.BitAnd,
}  # fmt: skip
_COMPARISON: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_TYPES = {"Float", "Int64", "Bool", "Literal", "Callable"}
"""What a subscript of is a type: nothing of it runs."""
_NOT_RUN = {"annotation", "returns", "decorator_list"}
_REMOVABLE = (ast.Expr, ast.AugAssign, ast.Raise, ast.Continue, ast.Break)


@dataclass(frozen=True)
class Mutant:
    """One fault.

    Attributes:
        kind: which of the kinds above.
        line: of the module, where it is.
        before: the replaced expression or statement ...
        after: ... and what stands in its place, "" for nothing.
        place: the first line of the statement around it.
        source: of the whole module.
    """

    kind: str
    line: int
    before: str
    after: str
    place: str
    source: str

    def __str__(self) -> str:
        return f"{self.line}: {_short(self.before)}  ->  {_short(self.after) or '(nothing)'}  in  {_short(self.place)}"


def mutants(source: str) -> list[Mutant]:
    """All mutants of a module's source, in its order."""
    tree = ast.parse(source)
    found = []
    for place, kind, new in _changes(tree):
        old, around = place.node, ast.unparse(place.statement).splitlines()[0]
        before, after = ast.unparse(old), "" if isinstance(new, ast.Pass) else ast.unparse(new)
        if kind == "keyword":
            before, after = _left_out(old, new), "its default"
        place.put(new)
        whole = f"{ast.unparse(ast.fix_missing_locations(tree))}\n{MARK} = True\n"
        place.put(old)
        found.append(Mutant(kind, getattr(old, "lineno", 0), before, after, around, whole))
    return found


def _left_out(old: ast.AST, new: ast.AST) -> str:
    assert isinstance(old, ast.Call) and isinstance(new, ast.Call)
    return ast.unparse(next(keyword for keyword in old.keywords if keyword not in new.keywords))


@dataclass(frozen=True)
class _Place:
    """Where a node hangs in the tree."""

    parent: ast.AST
    field: str
    index: int | None
    statement: ast.AST
    """The innermost around it, or itself."""

    @property
    def node(self) -> ast.AST:
        value = getattr(self.parent, self.field)
        return value if self.index is None else value[self.index]

    def put(self, node: ast.AST) -> None:
        if self.index is None:
            setattr(self.parent, self.field, node)
        else:
            getattr(self.parent, self.field)[self.index] = node


def _changes(
    parent: ast.AST, bound: frozenset[str] = frozenset(), statement: ast.AST | None = None
) -> Iterator[tuple[_Place, str, ast.AST]]:
    """The replacements below a node; `bound` are names that have a value there, `statement` is what it is part of."""
    if isinstance(parent, ast.FunctionDef):
        bound = frozenset(argument.arg for argument in [*parent.args.args, *parent.args.kwonlyargs])
    for name, value in ast.iter_fields(parent):
        if name in _NOT_RUN:
            continue
        for index, node in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if not isinstance(node, ast.AST) or _is_left_alone(node):
                continue
            around = node if isinstance(node, ast.stmt) else statement or node
            place = _Place(parent, name, index, around)
            tested = isinstance(parent, ast.If | ast.IfExp | ast.While) and name == "test" or name == "ifs"
            if tested and not _is_negated_anyhow(node):
                yield place, "condition", ast.UnaryOp(ast.Not(), node)
            for kind, new in _replacements(node):
                yield place, kind, ast.copy_location(new, node)
            if isinstance(node, _REMOVABLE) or isinstance(node, ast.Assign) and _can_go(node, bound):
                yield place, "statement", ast.copy_location(ast.Pass(), node)
            yield from _changes(node, bound, around)
            if isinstance(node, ast.Assign):
                bound = bound | _names(node)


def _is_negated_anyhow(test: ast.AST) -> bool:
    """Whether another mutant of this condition is its opposite."""
    if isinstance(test, ast.Compare):
        return len(test.ops) == 1 and isinstance(
            test.ops[0], ast.Eq | ast.NotEq | ast.Is | ast.IsNot | ast.In | ast.NotIn
        )
    return isinstance(test, ast.UnaryOp)


def _replacements(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    if isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in _ARITHMETIC:
        yield "arithmetic", _with(node, op=_ARITHMETIC[type(node.op)]())
    elif isinstance(node, ast.Compare):
        for index, operator in enumerate(node.ops):
            if type(operator) in _COMPARISON:
                other = _COMPARISON[type(operator)]()
                yield "comparison", _with(node, ops=[*node.ops[:index], other, *node.ops[index + 1 :]])
    elif isinstance(node, ast.BoolOp):
        yield "boolean", _with(node, op=ast.Or() if isinstance(node.op, ast.And) else ast.And())
    elif isinstance(node, ast.UnaryOp):
        yield "boolean", node.operand
    elif isinstance(node, ast.Constant):
        if (value := _other(node.value)) is not None:
            yield "constant", ast.Constant(value)
    elif isinstance(node, ast.Call):
        for index, keyword in enumerate(node.keywords):
            if keyword.arg is not None:
                yield "keyword", _with(node, keywords=node.keywords[:index] + node.keywords[index + 1 :])


def _with(node: ast.AST, **fields: object) -> ast.AST:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def _other(value: object) -> bool | int | float | str | bytes | None:
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1
    if isinstance(value, float):
        return 2 * value if value else 1.0
    if isinstance(value, str):
        return "XX" + value
    return b"XX" + value if isinstance(value, bytes) else None


def _is_left_alone(node: ast.AST) -> bool:
    if isinstance(node, ast.Import | ast.ImportFrom):
        return True
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return True  # a docstring
    if isinstance(node, ast.Expr) and ast.unparse(node).startswith("assert_never("):
        return True  # never runs; the type checker sees to that
    if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Subscript):
        return False
    return isinstance(node.value.value, ast.Name) and node.value.value.id in _TYPES


def _can_go(statement: ast.Assign, bound: frozenset[str]) -> bool:
    """Whether what follows can run without it: otherwise its absence is no more than a name that is not defined."""
    if any(isinstance(target, ast.Subscript | ast.Attribute) for target in statement.targets):
        return True
    return _names(statement) <= bound


def _names(statement: ast.Assign) -> frozenset[str]:
    found = (item for target in statement.targets for item in ast.walk(target))
    return frozenset(item.id for item in found if isinstance(item, ast.Name))


def _short(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= 80 else line[:77] + "..."
