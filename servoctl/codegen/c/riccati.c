/* The Riccati equation from sample to sample. */
#include "rows.h"

/* S Y = Y by Gauss's elimination with partial pivoting; S is (NU, NU) and Y (NU, N), both are overwritten. */
INLINE void solve(double S[NU][NU], V Y[NU][BLOCKS])
{
    for (int i = 0; i < NU; i++) {
        int best = i;
        for (int k = i + 1; k < NU; k++) if (fabs(S[k][i]) > fabs(S[best][i])) best = k;
        for (int j = 0; j < NU; j++) { const double s = S[i][j]; S[i][j] = S[best][j]; S[best][j] = s; }
        EACH_BLOCK(j) { const V y = Y[i][j]; Y[i][j] = Y[best][j]; Y[best][j] = y; }
        for (int k = i + 1; k < NU; k++) {
            const double factor = S[k][i] / S[i][i];
            for (int j = i; j < NU; j++) S[k][j] -= factor * S[i][j];
            EACH_BLOCK(j) Y[k][j] -= factor * Y[i][j];
        }
    }
    for (int i = NU - 1; i >= 0; i--) {
        for (int k = i + 1; k < NU; k++) EACH_BLOCK(j) Y[i][j] -= S[i][k] * Y[k][j];
        EACH_BLOCK(j) Y[i][j] /= S[i][i];
    }
}

/* At one sample after another H = R + B'PB, G = H^-1 B'P and K = G A, then P = Q + A'P(A - BK). A is (N, N), B (N, NU)
   and Q (N, N), with the distances from a matrix and from a row to the next in numbers; R and P have no gaps. The gains
   (NU, N) are K or G, the matrices H are (NU, NU). */
void FN(riccati)(int64_t count, const double *A, int64_t A_next, int64_t A_row, const double *B, int64_t B_next,
                 int64_t B_row, const double *Q, int64_t Q_next, int64_t Q_row, const double *R, int64_t of_state,
                 double *P, double *gains, double *weights)
{
    V a[N][BLOCKS], p[N][BLOCKS], G[NU][BLOCKS], K[NU][BLOCKS], closed[N][BLOCKS], moved[N][BLOCKS], next[N][BLOCKS];
    double S[NU][NU];
    for (int i = 0; i < N; i++) loaded(p[i], P + i * N);
    for (int64_t sample = 0; sample < count; sample++, A += A_next, B += B_next, Q += Q_next) {
        for (int i = 0; i < N; i++) loaded(a[i], A + i * A_row);
        for (int i = 0; i < NU; i++) COMBINE(G[i], 1, N, B[k * B_row + i], p)
        for (int i = 0; i < NU; i++) for (int j = 0; j < NU; j++) {
            S[i][j] = R[i * NU + j];
            for (int k = 0; k < N; k++) S[i][j] += ENTRY(G[i], k) * B[k * B_row + j];
            *weights++ = S[i][j];
        }
        solve(S, G);
        for (int i = 0; i < NU; i++) COMBINE(K[i], 1, N, ENTRY(G[i], k), a)
        for (int i = 0; i < N; i++) COMBINE(closed[i], -1, NU, B[i * B_row + k], K)
        for (int i = 0; i < N; i++) EACH_BLOCK(j) closed[i][j] += a[i][j];
        for (int i = 0; i < N; i++) COMBINE(moved[i], 1, N, ENTRY(p[i], k), closed)
        for (int i = 0; i < N; i++) COMBINE(next[i], 1, N, ENTRY(a[k], i), moved)
        for (int i = 0; i < N; i++) for (int j = 0; j < N; j++) ENTRY(next[i], j) += Q[i * Q_row + j];
        for (int i = 0; i < N; i++) for (int j = 0; j < N; j++) ENTRY(p[i], j) = (ENTRY(next[i], j) + ENTRY(next[j], i)) / 2;
        for (int i = 0; i < NU; i++) for (int k = 0; k < N; k++) *gains++ = of_state ? ENTRY(K[i], k) : ENTRY(G[i], k);
    }
    for (int i = 0; i < N; i++) for (int k = 0; k < N; k++) P[i * N + k] = ENTRY(p[i], k);
}
