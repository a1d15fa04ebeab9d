/* min v'Hv/2 subject to rows v >= b for n unknowns, n small: the dual active-set method of Goldfarb and Idnani (1983). It
   starts at v = 0 and adds the constraint that is violated most, until none is. In the metric of H = LL' the constraints
   are the columns of inv(L) rows', which are orthogonalised anew in each step. A constraint is met up to QP_MET of 1 and
   of its terms, which may be large where v = 0 is far from it. Before it, N_QP and M_QP are the numbers of unknowns and
   of constraints. */
#include "unit.h"

#ifndef SMALL_QP_H
#define SMALL_QP_H

typedef struct {
    double L[N_QP][N_QP], normal[M_QP][N_QP], Q[N_QP][N_QP], R[N_QP][N_QP], u[N_QP + 1];
    int active[N_QP + 1], count;
} QP;

/* a = inv(L) a, or inv(L') a */
static void qp_forward(const QP *q, double *a)
{
    for (int i = 0; i < N_QP; i++) {
        for (int j = 0; j < i; j++) a[i] -= q->L[i][j] * a[j];
        a[i] /= q->L[i][i];
    }
}

static void qp_backward(const QP *q, double *a)
{
    for (int i = N_QP - 1; i >= 0; i--) {
        for (int j = i + 1; j < N_QP; j++) a[i] -= q->L[j][i] * a[j];
        a[i] /= q->L[i][i];
    }
}

/* z = the part of a that is orthogonal to the columns before k; r = its coefficients in them. Twice is enough. */
static void qp_project(const QP *q, int k, const double *a, double *z, double *r)
{
    for (int i = 0; i < N_QP; i++) z[i] = a[i];
    for (int c = 0; c < k; c++) r[c] = 0;
    for (int twice = 0; twice < 2; twice++) for (int c = 0; c < k; c++) {
        double s = 0;
        for (int i = 0; i < N_QP; i++) s += q->Q[c][i] * z[i];
        for (int i = 0; i < N_QP; i++) z[i] -= s * q->Q[c][i];
        r[c] += s;
    }
}

static void qp_factorise(QP *q)
{
    for (int k = 0; k < q->count; k++) {
        double *z = q->Q[k], r[N_QP], size = 0;
        qp_project(q, k, q->normal[q->active[k]], z, r);
        for (int c = 0; c < k; c++) q->R[c][k] = r[c];
        for (int i = 0; i < N_QP; i++) size += z[i] * z[i];
        q->R[k][k] = sqrt(size);
        for (int i = 0; i < N_QP; i++) z[i] /= q->R[k][k];
    }
}

/* v from the active constraints alone: the least in the metric of H that meets them. */
static void qp_polish(const QP *q, const double *b, double *v)
{
    double c[N_QP];
    for (int k = 0; k < q->count; k++) {
        c[k] = b[q->active[k]];
        for (int j = 0; j < k; j++) c[k] -= q->R[j][k] * c[j];
        c[k] /= q->R[k][k];
    }
    for (int i = 0; i < N_QP; i++) {
        v[i] = 0;
        for (int k = 0; k < q->count; k++) v[i] += q->Q[k][i] * c[k];
    }
    qp_backward(q, v);
}

/* Whether there is a solution v. */
static int small_qp(const double (*H)[N_QP], const double (*rows)[N_QP], const double *b, double *v)
{
    QP q = {.count = 0};
    for (int i = 0; i < N_QP; i++) for (int j = 0; j <= i; j++) {
        double s = H[i][j];
        for (int k = 0; k < j; k++) s -= q.L[i][k] * q.L[j][k];
        q.L[i][j] = i == j ? sqrt(s) : s / q.L[j][j];
    }
    for (int m = 0; m < M_QP; m++) {
        for (int i = 0; i < N_QP; i++) q.normal[m][i] = rows[m][i];
        qp_forward(&q, q.normal[m]);
    }
    for (int i = 0; i < N_QP; i++) v[i] = 0;
    for (int iteration = 0; iteration < QP_STEPS; iteration++) {
        double worst = 0, own = 0;
        int new = -1;
        for (int m = 0; m < M_QP; m++) {
            double s = -b[m], terms = 1 + fabs(b[m]);
            for (int i = 0; i < N_QP; i++) {
                s += rows[m][i] * v[i];
                terms += fabs(rows[m][i] * v[i]);
            }
            if (!(s >= worst || (isfinite(s) && s >= -QP_MET * terms))) {
                worst = s;
                new = m;
            }
        }
        if (new < 0) return 1;
        if (!isfinite(worst)) return 0;
        for (;;) {
            double z[N_QP], r[N_QP + 1], length = 0, size = 0, partial = INFINITY, full = INFINITY, s = -b[new];
            int leaving = -1;
            qp_factorise(&q);
            qp_project(&q, q.count, q.normal[new], z, r);
            for (int k = q.count - 1; k >= 0; k--) {
                for (int j = k + 1; j < q.count; j++) r[k] -= q.R[k][j] * r[j];
                r[k] /= q.R[k][k];
            }
            for (int i = 0; i < N_QP; i++) {
                length += z[i] * z[i];
                size += q.normal[new][i] * q.normal[new][i];
                s += rows[new][i] * v[i];
            }
            for (int k = 0; k < q.count; k++) if (r[k] > 0 && q.u[k] / r[k] < partial) {
                partial = q.u[k] / r[k];
                leaving = k;
            }
            if (length > QP_DEPENDENT * QP_DEPENDENT * size && q.count < N_QP) full = -s / length;
            const double step = partial < full ? partial : full;
            if (!(step < INFINITY)) return 0;
            for (int k = 0; k < q.count; k++) q.u[k] -= step * r[k];
            own += step;
            if (full < INFINITY) {
                qp_backward(&q, z);
                for (int i = 0; i < N_QP; i++) v[i] += step * z[i];
            }
            if (full <= partial) {
                q.active[q.count] = new;
                q.u[q.count++] = own;
                qp_factorise(&q);
                qp_polish(&q, b, v);
                break;
            }
            q.count--;
            for (int k = leaving; k < q.count; k++) {
                q.active[k] = q.active[k + 1];
                q.u[k] = q.u[k + 1];
            }
        }
    }
    return 0;
}

#endif
