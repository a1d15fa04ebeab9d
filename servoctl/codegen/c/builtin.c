/* NAME as a builtin function of Python, (t, x, p) -> a new array y: a call through ctypes takes as long as 300 products.

   The functions of Python and NumPy come as addresses, so that the unit needs neither their headers nor their libraries;
   all are of their stable interfaces, as are the fields of an array. */
#include <stddef.h>
#include "unit.h"

typedef struct {
    ptrdiff_t references;
    void *type, *type_of_numbers;
    char kind, letter, order, unused;
    int number;
} Numbers; /* the first fields of PyArray_Descr */

typedef struct {
    ptrdiff_t references;
    void *type;
    double *data;
    int axes;
    ptrdiff_t *shape, *strides;
    void *base;
    Numbers *numbers;
    int flags;
} Array; /* the first fields of PyArrayObject */

static struct {
    double (*number)(void *object);
    void *(*failed)(void);
    void (*forgive)(void);
    void *(*call)(void *callable, void *const *arguments, size_t n, void *names);
    void *(*function)(void *method, void *self, void *module);
    void *(*array)(void *type, int axes, const ptrdiff_t *shape, int number, const ptrdiff_t *strides, void *data,
                   int bytes, int flags, void *object);
    void *arrays; /* the type numpy.ndarray */
} python;

enum { DOUBLE = 12, READABLE = 0x101, FASTCALL_KEYWORDS = 0x82 }; /* READABLE: contiguous and aligned */

/* Whether an object is a plain array of n doubles, one after the other, that the processor can read. */
static int is_array(const Array *array, ptrdiff_t n)
{
    return array->type == python.arrays && array->axes == 1 && array->shape[0] == n
        && array->numbers->number == DOUBLE && array->numbers->order == '=' && (array->flags & READABLE) == READABLE;
}

/* What `otherwise` returns where t is no number, or x or p no array of its size; 0 with Python's error. */
static void *called(void *otherwise, void *const *arguments, ptrdiff_t n, void *names)
{
    static const ptrdiff_t shape[1] = {NY};
    if (n != 3 || names) return python.call(otherwise, arguments, n, names);
    double t = python.number(arguments[0]); /* may run code in Python that changes arrays: before they are read */
    if (t == -1.0 && python.failed()) python.forgive();
    else if (is_array(arguments[1], NX) && is_array(arguments[2], NP)) {
        const Array *x = arguments[1], *p = arguments[2], *y = python.array(python.arrays, 1, shape, DOUBLE, 0, 0, 0, 0, 0);
        if (y) NAME(t, x->data, p->data, y->data);
        return (void *)y;
    }
    return python.call(otherwise, arguments, n, 0);
}

/* A new builtin function; `functions` are the addresses of `python` above. */
void *FN(builtin)(void *const *functions, void *otherwise)
{
    static struct { const char *name; void *(*call)(void *, void *const *, ptrdiff_t, void *);
                    int flags; const char *text; }
        method = {"evaluate", called, FASTCALL_KEYWORDS, 0};
    void **place = (void **)&python;
    for (size_t i = 0; i < sizeof python / sizeof *place; i++) place[i] = functions[i];
    return python.function(&method, otherwise, 0);
}
