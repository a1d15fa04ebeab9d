"""Constant factors of products: a coefficient of (a x) (b y) takes one product by a b in place of one in each term."""

from copy import copy

from servoctl.jets.tape import Node
from servoctl.values import frozen


@frozen
class _Product:
    """number · constant · node, where `constant` is a node without time derivatives, or None."""

    number: float
    constant: int | None
    node: int


def constants_outside(tape, constants):
    """A tape whose products of series have no constant factors inside, and are the same for the same factors.

    `constants` is the set of the indices of the inputs that are constant.
    """
    result = copy(tape)
    for cached in ("plan", "growing", "_plans"):
        result.__dict__.pop(cached, None)
    rewritten = _Rewritten(tape, constants)
    result.nodes, result.outputs = rewritten.nodes, [rewritten.node(i) for i in tape.outputs]
    rewritten.set_slopes()
    return result


class _Rewritten:
    """The nodes of a tape written anew, in its order."""

    def __init__(self, tape, constants):
        self.old, self.inputs, self.nodes, self.known, self.quads = tape.nodes, constants, [], {}, []
        self.products, self.constant = [], []
        for i, node in enumerate(tape.nodes):
            self.constant.append(node.data in constants if node.kind == "input" else self._all(node))
            self.products.append(self._product(i, node))

    def _all(self, node):
        return node.kind == "const" or bool(node.args) and all(self.constant[a] for a in node.args)

    def _add(self, kind, *args, data=None):
        """A node, the same for the same operation."""
        args = tuple(sorted(args)) if kind == "mul" else args
        if (kind, args, data) not in self.known:
            self.nodes.append(Node(kind, args, data))
            self.known[kind, args, data] = len(self.nodes) - 1
        return self.known[kind, args, data]

    def node(self, i):
        """The new node that equals an old one."""
        p = self.products[i]
        if p.constant is None:
            return self._scaled(p.node, p.number)
        return self._add("mul", self._scaled(p.constant, p.number), p.node)

    def _scaled(self, node, number):
        if number == -1.0:
            return self._add("neg", node)
        return node if number == 1.0 else self._add("scale", node, data=number)

    def _product(self, i, node):
        if not self.constant[i] and node.kind in ("mul", "sq", "neg", "scale"):
            factors = [self._factor(a) for a in (node.args * 2 if node.kind == "sq" else node.args)]
            if node.kind in ("neg", "scale"):
                (factor,) = factors
                number = -1.0 if node.kind == "neg" else node.data
                return _Product(number * factor.number, factor.constant, factor.node)
            return self._of_two(*factors)
        if node.kind == "quad":
            self.nodes.append(Node("quad", tuple(map(self.node, node.args)), node.data))
            self.quads.append(len(self.nodes) - 1)
            return _Product(1.0, None, self.quads[-1])
        return _Product(1.0, None, self._add(node.kind, *map(self.node, node.args), data=node.data))

    def _factor(self, i):
        """An old node as a factor: a number, a constant, or a product."""
        if not self.constant[i]:
            return self.products[i]
        if self.old[i].kind == "const":
            return _Product(self.old[i].data, None, None)
        return _Product(1.0, self.node(i), None)

    def _of_two(self, a, b):
        number = a.number * b.number
        constant = [c for c in (a.constant, b.constant) if c is not None]
        constant = self._add("mul", *constant) if len(constant) == 2 else next(iter(constant), None)
        nodes = [n for n in (a.node, b.node) if n is not None]
        if len(nodes) == 1:
            return _Product(number, constant, nodes[0])
        return _Product(number, constant, self._add("sq", nodes[0]) if a.node == b.node else self._add("mul", *nodes))

    def set_slopes(self):
        """The slopes of functions, which may come after them."""
        for i in self.quads:
            name, slopes = self.nodes[i].data
            self.nodes[i] = self.nodes[i]._replace(data=(name, tuple(map(self.node, slopes))))
