/* The operations of a function as data, each at WIDTH points before the next; machine.py writes the list.

   An operation is (code, target, first operand, second operand), all but the code rows of w. The emitter defines codes
   INPUT_, CONST_ and OUTPUT_, and OPERATIONS: a case EACH(code, expression of a and b) for each of the others. */
#include <string.h>
#include "unit.h"

typedef struct { int32_t code, target, first, second; } Operation;

/* The target may be an operand, entry by entry. */
#define EACH(code, value) \
    case code: \
        _Pragma("GCC ivdep") for (int j = 0; j < WIDTH; j++) { const double a = u[j], b = v[j]; r[j] = value; (void)b; } \
        break;

/* One block: points k .. k + m - 1 of n. `inputs` are the numbers of t and x together; p follows. */
static void block(int64_t count, const Operation *restrict list, const double *restrict constants, int64_t inputs,
                  int64_t n, int64_t k, int64_t m, int64_t p_many, const double *t, const double *x, const double *p,
                  double *y, double (*w)[WIDTH])
{
    for (int64_t i = 0; i < count; i++) {
        const Operation o = list[i];
        if (o.code == OUTPUT_) {
            memcpy(y + o.target * n + k, w[o.first], m * sizeof *y);
        } else if (o.code == CONST_) {
            for (int j = 0; j < WIDTH; j++) w[o.target][j] = constants[i];
        } else if (o.code == INPUT_) {
            double *r = w[o.target];
            if (o.first >= inputs && !p_many) {
                for (int j = 0; j < WIDTH; j++) r[j] = p[o.first - inputs];
            } else {
                const double *from = o.first == 0 ? t : o.first < inputs ? x + (o.first - 1) * n
                                                                         : p + (o.first - inputs) * n;
                memcpy(r, from + k, m * sizeof *r);
                for (int64_t j = m; j < WIDTH; j++) r[j] = r[0];
            }
        } else {
            const double *u = w[o.first], *v = w[o.second];
            double *r = w[o.target];
            switch (o.code) { OPERATIONS }
        }
    }
}

void FN(machine)(int64_t count, int64_t inputs, int64_t n, int64_t p_many, const Operation *list,
                 const double *constants, const double *t, const double *x, const double *p, double *y, double *w)
{
    for (int64_t k = 0; k < n; k += WIDTH)
        block(count, list, constants, inputs, n, k, n - k < WIDTH ? n - k : WIDTH, p_many, t, x, p, y,
              (double (*)[WIDTH])w);
}
