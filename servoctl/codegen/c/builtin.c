/* NAME as a builtin function of Python, (t, x, p) -> a new array y: a call through ctypes takes as long as 300 products.

   The functions of Python come as addresses, so that the unit needs neither Python's headers nor its library; all but
   `empty` are of the stable interface of Python 3.11 and later. */
#include <stddef.h>
#include "unit.h"

typedef struct {
    double *data;
    void *object;
    ptrdiff_t bytes, item;
    int readonly, axes;
    char *format;
    ptrdiff_t *shape, *strides, *suboffsets;
    void *internal;
} Buffer; /* Py_buffer */

static struct {
    int (*buffer)(void *object, Buffer *, int flags);
    void (*release)(Buffer *);
    double (*number)(void *object);
    void *(*failed)(void);
    void (*forgive)(void);
    void *(*item)(void *tuple, ptrdiff_t);
    void *(*call)(void *callable, void *const *arguments, size_t n, void *names);
    void (*keep)(void *object);
    void *(*function)(void *method, void *self, void *module);
} python;

enum { SIMPLE = 0, WRITABLE = 1, WITH_FORMAT = 4, CONTIGUOUS = 0x38, FASTCALL = 0x80 };

/* Whether an object is an array of n doubles, one after the other; its buffer has to be released then. */
static int is_array(void *object, ptrdiff_t n, Buffer *array)
{
    if (python.buffer(object, array, WITH_FORMAT | CONTIGUOUS)) {
        python.forgive();
        return 0;
    }
    if (array->axes == 1 && array->shape[0] == n && array->format[0] == 'd' && !array->format[1]) return 1;
    python.release(array);
    return 0;
}

/* The new array; 0 with Python's error where there is no memory. `self` is the tuple (empty, NY, None). */
static void *evaluated(void *self, double t, const double *x, const double *p)
{
    void *size = python.item(self, 1), *result = python.call(python.item(self, 0), &size, 1, 0);
    Buffer y;
    if (result && !python.buffer(result, &y, WRITABLE)) {
        NAME(t, x, p, y.data);
        python.release(&y);
    }
    return result;
}

/* None where t is no number, or x or p no array of its size. */
static void *called(void *self, void *const *arguments, ptrdiff_t n)
{
    void *result = python.item(self, 2);
    Buffer x, p;
    if (n != 3 || !is_array(arguments[1], NX, &x)) return python.keep(result), result;
    double t = python.number(arguments[0]);
    if (t == -1.0 && python.failed()) python.forgive();
    else if (is_array(arguments[2], NP, &p)) {
        result = evaluated(self, t, x.data, p.data);
        python.release(&p);
        python.release(&x);
        return result;
    }
    python.release(&x);
    return python.keep(result), result;
}

/* A new builtin function; `functions` are the addresses of `python` above. */
void *FN(builtin)(void *const *functions, void *self)
{
    static struct { const char *name; void *(*call)(void *, void *const *, ptrdiff_t); int flags; const char *text; }
        method = {"evaluate", called, FASTCALL, 0};
    void **place = (void **)&python;
    for (size_t i = 0; i < sizeof python / sizeof *place; i++) place[i] = functions[i];
    return python.function(&method, self, 0);
}
