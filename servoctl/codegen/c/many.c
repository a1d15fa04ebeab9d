/* Motions of many cases by the Taylor method: the lanes of W are motions with steps of their own, and a lane whose motion
   ends takes the next case that no thread has taken. Before it come `expansion`, the function of taylor.c in lanes, with its
   sizes, and `off_manifold`, by which part of the state's size it violates the invariants. */
#include "unit.h"
#include "lanes.h"
#include "series.h"
#include "cases.h"

#define UNROLLED _Pragma("GCC unroll 32") /* a loop whose conditions are decided when it is compiled */
#define COEFFICIENTS ((PLAIN ? 0 : NQ * LAST) + N * LAST) /* outputs before the pivots */

typedef struct {
    W t, x[NX + 1], p[NP + 1], work[WORK], y[NY + 1], atol, h, largest[NX + 1];
    W pivots[NY - COEFFICIENTS + 1], signs[NY - COEFFICIENTS + 1];
    W ahead[N + 1]; /* gamma^(s) at the end of the step, by its series */
    I steps;
    int64_t of[W_LANES], sampled[W_LANES];
    struct {
        W t, x[NX + 1], p[NP + 1];
        int64_t count, of[W_LANES];
    } noted; /* starts and ends of motions, of which it is not known yet by how much they violate the invariants */
} Motions;

/* `rough_log2` of series.h in lanes, as a polynomial of the mantissa, 1 + f. */
INLINE W w_rough_log2(W a)
{
    const W mantissa = w_value((w_bits(a) & 0x000fffffffffffffLL) | 0x3ff0000000000000LL);
    const W exponent = __builtin_convertvector(w_bits(a) >> 52, W) - (1024.0 + 2 * BEND);
    return exponent + mantissa * (1.0 + 3 * BEND - BEND * mantissa);
}

INLINE W w_rough_exp2(W a)
{
    const W within = w_fmax(w_fmin(a, ALL((double)REST)), ALL(-1022.0));
    const I above = __builtin_convertvector(within, I), whole = above + (__builtin_convertvector(above, W) > within);
    const W f = within - __builtin_convertvector(whole, W);
    return w_value((whole + 1023) << 52) * (1.0 + f * (1.0 - BEND + BEND * f));
}

INLINE W w_largest(const W *v, int64_t n, int64_t level)
{
    W largest = ALL(0.0);
    int some = 0;
    UNROLLED for (int64_t i = 0; i < n; i++) {
        if (level && !IS_FREE((level - 1) * N + i)) continue;
        largest = some ? w_larger_size(w_fabs(v[i]), largest) : w_fabs(v[i]);
        some = 1;
    }
    return largest;
}

/* `length` of taylor.c in lanes. */
INLINE W w_length(const W *x, const W *c, int64_t n, int64_t level, double log_rtol, W least)
{
    const W scale = w_rough_log2(least + w_largest(x, n, level));
    W shortest = ALL(INFINITY);
    UNROLLED for (int64_t m = 0; m < TERMS; m++) {
        const int64_t k = term(m);
        if (k <= level || k == 0) continue;
        const W size = w_rough_log2(w_largest(c + (k - 1) * n, n, level));
        const double part = 1.0 / (double)(k - level);
        const double all = log_rtol * (1.0 / (double)(LAST - level)) - rough_log2(falling(k, level)) * part;
        shortest = w_lesser((scale - size) * part + all, shortest);
    }
    return shortest;
}

/* gamma^(j) or, for j = 0, the change of q, a time h after the expansion: by W. G. Horner's scheme, in which h has the
   ratio of the factors of two terms. */
INLINE W w_series(const W *c, int64_t n, int64_t i, int64_t j, W h)
{
    W total = c[(LAST - 1) * n + i];
    UNROLLED for (int64_t k = LAST - 1; k >= (j ? j : 1); k--) {
        total = total * (falling(k + 1, j) / falling(k, j) * h) + c[(k - 1) * n + i];
    }
    return j ? falling(j, j) * total : total * h;
}

/* By how much the noted points violate the invariants: of a case the larger one of start and end counts. */
static void judge(const Many *m, Motions *s)
{
    W off;
    off_manifold(s->noted.t, s->noted.x, s->noted.p, &off);
    for (int64_t k = 0; k < s->noted.count; k++) widen(m->ends + s->noted.of[k] * (RESULTS + 2 * NX) + 3, off[k]);
    s->noted.count = 0;
}

/* Note the point of a lane; where there are as many as lanes, they are judged at once. */
static void note(const Many *m, int64_t lane, Motions *s)
{
    const int64_t k = s->noted.count++;
    s->noted.of[k] = s->of[lane];
    s->noted.t[k] = s->t[lane];
    for (int64_t i = 0; i < NX; i++) s->noted.x[i][k] = s->x[i][lane];
    for (int64_t i = 0; i < NP; i++) s->noted.p[i][k] = s->p[i][lane];
    if (s->noted.count == W_LANES) judge(m, s);
}

/* Put the next case, or none, into a lane, which then rests at the start of the first case; whether there was one. */
static int load(Many *m, int64_t lane, Motions *s)
{
    const int64_t next = next_case(m), from = next < 0 ? 0 : next;
    s->of[lane] = next;
    s->t[lane] = m->t0;
    s->h[lane] = s->steps[lane] = s->sampled[lane] = 0;
    s->atol[lane] = m->atol[from];
    for (int64_t i = 0; i < NX; i++) s->x[i][lane] = m->x0[from * NX + i];
    for (int64_t i = 0; i < NX; i++) s->largest[i][lane] = fabs(m->x0[from * NX + i]);
    for (int64_t i = 0; i < NP; i++) s->p[i][lane] = m->p[from * NP + i];
    for (int64_t i = 0; i < NY - COEFFICIENTS; i++) s->pivots[i][lane] = m->pivots[i];
    for (int64_t i = 0; i < NY - COEFFICIENTS; i++) s->signs[i][lane] = 0;
    if (next >= 0) note(m, lane, s);
    return next >= 0;
}

static void end(const Many *m, int64_t lane, int64_t outcome, Motions *s)
{
    double *row = m->ends + s->of[lane] * (RESULTS + 2 * NX);
    row[0] = (double)outcome;
    row[1] = (double)s->steps[lane];
    row[2] = s->t[lane];
    for (int64_t i = 0; i < NX; i++) row[RESULTS + i] = s->x[i][lane];
    for (int64_t i = 0; i < NX; i++) row[RESULTS + NX + i] = s->largest[i][lane];
    note(m, lane, s);
}

/* The samples of a lane in its next step. */
static void sample(const Many *m, int64_t lane, double h, int ends, Motions *s)
{
    const double forward = m->t1 > m->t0 ? 1 : -1, t = s->t[lane];
    const int64_t c = PLAIN ? 0 : NQ * LAST;
    double p[NP + 1];
    for (int64_t k; (k = s->sampled[lane]) < m->n_times; s->sampled[lane]++) {
        const double after = m->times[k] - t;
        if (!ends && forward * after > forward * h) return;
        double *row = m->samples + (s->of[lane] * m->n_times + k) * NX;
        for (int64_t i = 0; i < NX; i++) {
            const int64_t j = i < NQ ? 0 : 1 + (i - NQ) / N, n = i < NQ ? NQ : N, place = i < NQ ? i : (i - NQ) % N;
            double total = 0;
            for (int64_t a = LAST; a >= (j ? j : 1); a--) {
                total = total * after + falling(a, j) * s->y[(j ? c : 0) + (a - 1) * n + place][lane];
            }
            row[i] = j ? total : s->x[i][lane] + total * after;
        }
        for (int64_t i = 0; i < NP; i++) p[i] = s->p[i][lane];
        settle(m->times[k], row, p);
    }
}

/* Whether a pivot has another sign than at the start, or is far below or above its largest size so far. */
INLINE I falling_pivots(Motions *s)
{
    I bad = w_bits(ALL(0.0));
    for (int64_t i = 0; i < NY - COEFFICIENTS; i++) {
        const W value = s->y[COEFFICIENTS + i], size = w_fabs(value);
        bad |= ~(size >= DEGRADED * s->pivots[i]) | (value * s->signs[i] < 0) | (size * NEGLIGIBLE > s->pivots[i]);
        s->signs[i] = value;
        s->pivots[i] = w_larger_size(s->pivots[i], size);
    }
    return bad;
}

/* Whether the series before does not meet the equations at the end of its step: an error of gamma^(s) is judged by what it
   is at the highest level that is integrated. */
INLINE I off(const Motions *s, const W *c, double rtol)
{
    I wrong = w_bits(ALL(0.0));
    UNROLLED for (int64_t j = 0; j < TOP; j++) {
        W error = ALL(0.0), size = j ? w_largest(s->x + NQ + (j - 1) * N, N, 0) : w_largest(s->x, NQ, 0);
        W part = ALL(falling(LAST, j) / falling(LAST, TOP - 1));
        for (int64_t m = j; m < TOP; m++) part *= s->h;
        UNROLLED for (int64_t i = 0; i < N; i++) {
            if (highest_level(i) != j) continue;
            const W now = falling(TOP, TOP) * c[(TOP - 1) * N + i];
            error = w_larger_size(error, w_fabs(part * (now - s->ahead[i])));
            size = w_larger_size(size, w_fabs(part * now));
        }
        wrong |= ~(error <= FAR_OFF * (s->atol + rtol * size));
    }
    return (s->h != 0) & wrong;
}

/* Called by each thread. */
void FN(many)(Many *m)
{
    const double log_rtol = log2(LAST_TERM * m->rtol), forward = m->t1 > m->t0 ? 1 : -1;
    Motions s = {0};
    int64_t open = 0;
    for (int64_t lane = 0; lane < W_LANES; lane++) open += load(m, lane, &s);
    expansion_still(s.t, s.x, s.p, s.y, s.work);
    for (int64_t steps = 0; open; steps++) {
        if (stopped(m) || steps == m->most) break;
        expansion_moving(s.t, s.x, s.p, s.y, s.work);
        const W *c = s.y + (PLAIN ? 0 : NQ * LAST), least = s.atol / m->rtol;
        W log_h = w_length(s.x, s.y, NQ, 0, log_rtol, least);
        for (int64_t j = 1; j < TOP; j++) {
            const W of_level = w_length(s.x + NQ + (j - 1) * N, c, N, j, log_rtol, least);
            log_h = w_lesser(of_level, log_h);
        }
        for (int64_t i = 0; i < N * (TOP - 1); i++) {
            if (!IS_FREE(i)) s.x[NQ + i] = falling(1 + i / N, 1 + i / N) * c[i];
        }
        const W left = forward * (m->t1 - s.t);
        const I fallen = falling_pivots(&s), wrong = off(&s, c, m->rtol);
        const W h_long = w_rough_exp2(log_h);
        W x[NX + 1];
        const I ends = h_long >= left * (1 - 1e-12);
        W h = forward * w_select(ends, left, h_long);
        UNROLLED for (int64_t i = 0; i < NX; i++) {
            const int64_t j = i < NQ ? 0 : 1 + (i - NQ) / N;
            x[i] = s.x[i];
            if (j && !IS_FREE(i - NQ)) continue; /* rows determine it in the next expansion */
            const W part = j ? w_series(c, N, (i - NQ) % N, j, h) : w_series(s.y, NQ, i, 0, h);
            x[i] = j ? part : s.x[i] + part;
        }
        UNROLLED for (int64_t i = 0; i < N; i++) s.ahead[i] = w_series(c, N, i, TOP, h);
        W sum = ALL(0.0);
        for (int64_t i = 0; i < NX; i++) sum += x[i] * 0.0;
        const I stuck = ~(h_long > 1e-13 * (1.0 + w_fabs(s.t))) | (sum != 0) | (s.steps >= m->max_steps);
        const I arrived = s.t == m->t1, over = fallen | wrong | arrived | stuck;
        for (int64_t lane = 0; lane < W_LANES && (m->n_times || w_any(over)); lane++) {
            if (s.of[lane] < 0) continue;
            if (!over[lane]) {
                sample(m, lane, h[lane], (int)ends[lane], &s);
                continue;
            }
            end(m, lane, fallen[lane] ? PIVOT_FALLS : wrong[lane] ? SERIES_OFF : arrived[lane] ? FINISHED : STUCK, &s);
            open -= !load(m, lane, &s);
            for (int64_t i = 0; i < NX; i++) x[i][lane] = s.x[i][lane];
            h[lane] = s.steps[lane] = 0;
        }
        if (w_any(over)) expansion_still(s.t, s.x, s.p, s.y, s.work);
        s.steps += (h != 0) & 1;
        s.h = h;
        for (int64_t i = 0; i < NX; i++) {
            s.x[i] = x[i];
            s.largest[i] = w_larger_size(s.largest[i], w_fabs(x[i]));
        }
        s.t = w_select(ends & (h != 0), ALL(m->t1), s.t + h);
    }
    judge(m, &s);
}
