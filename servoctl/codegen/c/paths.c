/* Jets of references at many instants, for NumPy: of one list of paths, as in path.h. */
#include "piece.h"

/* The derivatives 0 .. order of n references at m times, of the pieces that instants select; NaN where either is none.
   A row of the result, which is zero before, has those of one time. */
void FN(paths)(double paths, int64_t n, int64_t order, int64_t m, const double *instants, const double *t, double *out)
{
    for (int64_t i = 0; i < n * m; i++) {
        const Path *path = (const Path *)(uintptr_t)paths + i % n;
        const double none = 0 * instants[i / n] + 0 * t[i / n];
        const Piece piece = path_at(path, instants[i / n] + none, t[i / n] + none);
        double *r = out + i / n * n * (order + 1) + i % n, power = 1, factorial = 1;
        for (int64_t j = piece.size - 1; j >= 0; j--)
            for (int64_t k = order; k >= 0; k--) r[k * n] = r[k * n] * piece.tau + (k ? r[(k - 1) * n] : piece.c[j]);
        for (int64_t k = 0; k <= order; k++) {
            r[k * n] = r[k * n] * power * factorial;
            power *= piece.scale;
            factorial *= (double)(k + 1);
        }
        if (fabs(piece.tau) == 1) path_rest(path, &piece, order, n, r);
    }
}
