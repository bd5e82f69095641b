"""Structured text run in Python: parsed by a grammar of tree-sitter, with types that have to agree and only what the
standard (IEC 61131-3) has. Conversions of real numbers to integers round in either way, as controllers do."""

import math

import numpy as np
import tree_sitter_iec61131_3_st
from tree_sitter import Language, Parser

TYPES = {"LREAL": np.float64, "REAL": np.float32, "DINT": np.int32, "UDINT": np.uint32, "BOOL": np.bool_}


class FunctionBlock:
    """An instance of the one function block of a text.

    Attributes:
        types: by name, of all variables.
        inputs, outputs: names.
        values: of all variables.
    """

    def __init__(self, text):
        tree = Parser(Language(tree_sitter_iec61131_3_st.language())).parse(text.encode()).root_node
        assert not tree.has_error, _first_fault(tree)
        (block,) = (node for node in tree.children if node.type != "comment")
        assert block.type == "function_block_declaration"
        self.types, self.values, self.constants, self._temporary = {}, {}, set(), {}
        self._literals, self._lines, places = [], [], {"var_input": [], "var_output": [], "var_temp": [], "var_block": []}
        self.name, *parts = (node for node in block.named_children if node.type not in ("comment", "empty_statement"))
        for node in parts:
            if node.type in places:
                places[node.type] += self._declare_variables(node)
        self.inputs, self.outputs = places["var_input"], places["var_output"]
        self._temporary = {name: self.types[name](0) for name in places["var_temp"]}
        # names are the same in capitals
        assert len({name.upper() for name in self.types}) == len(self.types)
        for node in parts:
            if node.type not in places:
                self._statement(node, 1)
        source = "\n".join(["def step(m, literals):", *self._lines])
        names = _NAMES | {"types": self.types}
        exec(compile(source, "structured text", "exec"), names)
        self._step = names["step"]

    def __call__(self, **inputs):
        """One step: outputs by name."""
        self.values |= self._temporary
        for name, value in inputs.items():
            self.values[name] = self.types[name](value)
        self._step(self.values, self._literals)
        assert all(type(self.values[name]) is kind for name, kind in self.types.items())
        return {name: self.values[name] for name in self.outputs}

    def _declare_variables(self, node):
        constant = any(child.type == "var_qualifier_list" for child in node.children)
        names = []
        for child in node.children:
            if child.type != "variable_declaration":
                continue
            name, kind, *first = child.named_children
            names.append(name.text.decode())
            self.types[names[-1]] = TYPES[kind.text.decode()]
            self.values[names[-1]] = self._constant(first[0]) if first else self.types[names[-1]](0)
            assert type(self.values[names[-1]]) is self.types[names[-1]]
            if constant:
                self.constants.add(names[-1])
        return names

    def _constant(self, node):
        if node.type == "boolean_literal":
            return np.bool_(node.text.decode() == "TRUE")
        assert node.type == "typed_literal", node.text
        kind, value = node.text.decode().split("#")
        return TYPES[kind](value)

    def _statement(self, node, depth):
        """Translate a statement to lines of Python."""
        indent = "    " * depth
        if node.type in ("comment", "empty_statement"):
            return
        named = [clause for clause in node.named_children if clause.type != "comment"]
        if node.type == "assignment_statement":
            name = named[0].text.decode()
            assert name in self.types and name not in self.constants and name not in self.inputs, name
            self._lines.append(f"{indent}m[{name!r}] = of(types[{name!r}], {self._expression(named[1])})")
        elif node.type in ("if_statement", "elsif_clause", "while_statement"):
            word = {"if_statement": "if", "elsif_clause": "elif", "while_statement": "while"}[node.type]
            self._lines.append(f"{indent}{word} of(BOOL, {self._expression(named[0])}):")
            clauses = [clause for clause in named[1:] if clause.type in ("elsif_clause", "else_clause")]
            self._body([clause for clause in named[1:] if clause not in clauses], depth + 1)
            for clause in clauses:
                self._statement(clause, depth)
        elif node.type == "else_clause":
            self._lines.append(f"{indent}else:")
            self._body(named, depth + 1)
        else:
            assert node.type == "for_statement", node.type
            name, first, last, *body = named
            assert self.types[name.text.decode()] is np.int32
            ends = f"{int(first.text)}, {int(last.text) + 1}"
            self._lines.append(f"{indent}for m[{name.text.decode()!r}] in map(DINT, range({ends})):")
            self._body(body, depth + 1)

    def _body(self, nodes, depth):
        assert nodes
        for node in nodes:
            self._statement(node, depth)

    def _expression(self, node):
        """Translate an expression to Python."""
        named = node.named_children
        if node.type == "identifier":
            assert node.text.decode() in self.types, node.text
            return f"m[{node.text.decode()!r}]"
        if node.type in ("typed_literal", "boolean_literal"):
            self._literals.append(self._constant(node))
            return f"literals[{len(self._literals) - 1}]"
        if node.type == "parenthesized_expression":
            return self._expression(named[0])
        if node.type == "unary_expression":
            return f"{ {'-': 'negative', 'NOT': 'negated'}[node.children[0].type] }({self._expression(named[0])})"
        if node.type == "binary_expression":
            word = node.children[1].type
            return f"binary[{word!r}]({', '.join(map(self._expression, named))})"
        assert node.type == "call_expression", node.type
        return f"called[{named[0].text.decode()!r}]({', '.join(map(self._expression, named[1].named_children))})"


def _first_fault(node):
    while not (node.is_error or node.is_missing):
        node = next(child for child in node.children if child.has_error or child.is_missing)
    return f"line {node.start_point.row + 1}: {node.text.decode()[:200]}"


def _require_type(kind, value):
    assert type(value) is kind, (kind, type(value))
    return value


def _require_alike(work, kinds=(np.floating, np.integer)):
    """Make `work` refuse two numbers unless both are of one of these kinds, and of the same type."""

    def checked_work(a, b):
        assert type(a) is type(b) and isinstance(a, kinds), (type(a), type(b))
        return work(a, b)

    return checked_work


def _divide(a, b):
    # a controller would stop
    assert b != 0
    return a / b if isinstance(a, np.floating) else type(a)(math.trunc(int(a) / int(b)))


def _negate(a):
    assert isinstance(a, (np.floating, np.signedinteger))
    return -a


def _square_root(a):
    assert isinstance(a, np.floating) and a >= 0.0, a
    return np.sqrt(a)


def _select_branch(condition, no, yes):
    assert type(condition) is np.bool_ and type(no) is type(yes)
    return yes if condition else no


class _Conversion:
    def __init__(self, from_type, to_type):
        self.from_type, self.to_type, self.rounds_up = from_type, to_type, False

    def __call__(self, value):
        assert type(value) is self.from_type
        if isinstance(value, np.floating) and not issubclass(self.to_type, np.floating):
            assert abs(value) < 2**31
            self.rounds_up = not self.rounds_up
            return self.to_type(math.ceil(value) if self.rounds_up else math.floor(value))
        return self.to_type(value)


_LOGIC = {"AND": np.logical_and, "OR": np.logical_or, "XOR": np.logical_xor}
_ORDER = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal, "=": np.equal, "<>": np.not_equal}
_ARITHMETIC = {"+": np.add, "-": np.subtract, "*": np.multiply, "/": _divide, "MOD": _require_alike(np.fmod, np.integer)}
_NAMES = {
    "of": _require_type,
    **TYPES,
    "negative": _negate,
    "negated": lambda a: ~_require_type(np.bool_, a),
    "binary": {word: _require_alike(work) for word, work in (_ARITHMETIC | _ORDER).items()}
    | {word: _require_alike(work, np.bool_) for word, work in _LOGIC.items()},
    "called": {
        "SQRT": _square_root,
        "ABS": lambda a: abs(_require_alike(lambda a, _: a)(a, a)),
        "MIN": _require_alike(np.minimum),
        "MAX": _require_alike(np.maximum),
        "SEL": _select_branch,
        **{f"{a}_TO_{b}": _Conversion(TYPES[a], TYPES[b]) for a in TYPES for b in TYPES if a != b},
    },
}
