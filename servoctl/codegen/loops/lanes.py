"""Several points at once, as C text: the vector type W with the functions that emitted statements call.

A function is emitted a second time, with ``V``, ``K`` and ``v_sin`` in their meanings for W. What has no formula here
or in `circular` is taken lane by lane. Values differ from the scalar ones by rounding.
"""

import re

from servoctl.codegen.loops.circular import FAR, turned

LANES = 8

_TYPES = """
enum { W_LANES = COUNT };
typedef double W __attribute__((vector_size(8 * COUNT)));
typedef int64_t I __attribute__((vector_size(8 * COUNT)));
typedef int8_t M __attribute__((vector_size(COUNT)));
typedef double U __attribute__((vector_size(8 * COUNT), aligned(8), may_alias));
#define ALL(c) ((W){SAME})

#define INLINE static inline __attribute__((always_inline))

INLINE W w_select(I mask, W a, W b) { return (W)((mask & (I)a) | (~mask & (I)b)); }
INLINE int w_any(I mask)
{
    const M bytes = __builtin_convertvector(mask, M);
    int64_t word = 0;
    __builtin_memcpy(&word, &bytes, W_LANES);
    return word != 0;
}
INLINE I w_bits(W a) { return (I)a; }
INLINE W w_value(I bits) { return (W)bits; }
INLINE W w_truth(I mask) { return (W)(mask & (I)ALL(1.0)); }
"""

_OWN = {
    "fabs": "(W)((I)a & 0x7fffffffffffffffLL)",
    "sign": "w_select(a < 0, ALL(-1.0), w_select(a > 0, ALL(1.0), a))",
    "not": "w_truth(a == 0)",
    "lt": "w_truth(a < b)",
    "le": "w_truth(a <= b)",
    "eq": "w_truth(a == b)",
    "ne": "w_truth(a != b)",
    "and": "w_truth((a != 0) & (b != 0))",
    "or": "w_truth((a != 0) | (b != 0))",
    "if_else_zero": "(W)((a != 0) & (I)b)",
    "fmin": "w_select((a <= b) | (b != b), a, b)",
    "fmax": "w_select((a >= b) | (b != b), a, b)",
}

_MODERATE = """
INLINE int w_moderate(W a) { return !w_any(~((W)((I)a & 0x7fffffffffffffffLL) < FAR)); }
"""

_MEANING = "#define V W\n#undef K\n#define K(constant) ALL(constant)\n"
_MEANT = "#undef V\n#undef K\n#define K(constant) (constant)\n"


def _by_lane(name, arguments):
    places = ", ".join(f"{a}[i]" for a in arguments)
    return f"    W r;\n    for (int i = 0; i < W_LANES; i++) r[i] = v_{name}({places});\n    return r;\n"


def _defined(name, arguments):
    """The C function of one operation."""
    head = f"W w_{name}({', '.join(f'W {a}' for a in arguments)})\n{{\n"
    if name in _OWN:
        return f"INLINE {head}    return {_OWN[name]};\n}}\n"
    if name in ("sin", "cos"):  # the value is made before the question, so that compilers make common parts once
        lane = f"    for (int i = 0; i < W_LANES; i++) if (!(fabs(a[i]) < FAR)) r[i] = v_{name}(a[i]);\n    return r;\n"
        far = f"static __attribute__((noinline, cold)) W w_far_{name}(W a, W r)\n{{\n{lane}}}\n"
        value = (
            f"    const W r = w_turned(a, {int(name == 'cos')});\n    return w_moderate(a) ? r : w_far_{name}(a, r);\n"
        )
        return f"{far}INLINE {head}{value}}}\n"
    return f"INLINE {head}{_by_lane(name, arguments)}}}\n"


def lanes(text, operations, n=LANES):
    """C text of a function for several points at once.

    Parameters
    ----------
    text : str
        Of the function, under its new name, in terms of V, K and operations v_NAME.
    operations : dict of str to (arguments, scalar)
        For each NAME its arguments, "a" or "ab", and the C function for which v_NAME is a macro, or None.
    n : int
        Number of points: a power of two.

    Returns
    -------
    str
    """
    used = {name: operations[name] for name in sorted(set(re.findall(r"\bv_(\w+)\(", text)))}
    functions = "".join(_defined(name, arguments) for name, (arguments, _) in used.items())
    begin = "".join(f"#undef v_{name}\n#define v_{name} w_{name}\n" for name in used)
    end = "".join(
        f"#undef v_{name}\n" + (f"#define v_{name} {scalar}\n" if scalar else "") for name, (_, scalar) in used.items()
    )
    types = f"#define FAR {FAR}" + _TYPES.replace("COUNT", str(n)).replace("SAME", ", ".join(n * ["(c)"]))
    circular = turned("w", "W", "I") + _MODERATE if used.keys() & {"sin", "cos"} else ""
    return "".join((types, circular, functions, begin, _MEANING, text, end, _MEANT))
