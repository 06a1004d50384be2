"""Dimensions of a buffer as the kernels' comments write them: `N+1`, `c1 + c2`, `(H-1)/2`."""

import ast
import functools
import operator
from collections.abc import Callable

OPERATORS = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.floordiv,
}


@functools.cache
def parse_formula(text: str) -> ast.expr:
    """The syntax tree of a formula of integers, names, brackets and + - * / (of whole numbers).

    Raises ValueError for anything else.
    """
    try:
        tree = ast.parse(text, mode="eval").body
    except SyntaxError:
        tree = None
    if not _is_formula(tree):
        raise ValueError(f"{text!r} is no formula of integers, names and + - * /")
    return tree


def _is_formula(node):
    if isinstance(node, ast.BinOp):
        return type(node.op) in OPERATORS and _is_formula(node.left) and _is_formula(node.right)
    return isinstance(node, ast.Name) or (
        isinstance(node, ast.Constant) and type(node.value) is int
    )


def names_in(tree: ast.expr) -> set[str]:
    """The names in a formula, as written."""
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def evaluate(tree: ast.expr, size_of: Callable[[str], int | None]) -> int | None:
    """The number of a formula; None where size_of(name) is None for one of its names."""
    if isinstance(tree, ast.BinOp):
        left, right = evaluate(tree.left, size_of), evaluate(tree.right, size_of)
        return None if None in (left, right) else OPERATORS[type(tree.op)](left, right)
    return tree.value if isinstance(tree, ast.Constant) else size_of(tree.id)
