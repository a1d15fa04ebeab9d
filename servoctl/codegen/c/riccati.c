/* The Riccati equation from sample to sample. */
#include "unit.h"

/* S Y = Y by Gauss's elimination with partial pivoting; S is (NU, NU) and Y (NU, N), both are overwritten. */
INLINE void solve(double S[NU][NU], double Y[NU][N])
{
    for (int i = 0; i < NU; i++) {
        int best = i;
        for (int k = i + 1; k < NU; k++) if (fabs(S[k][i]) > fabs(S[best][i])) best = k;
        for (int j = 0; j < NU; j++) { const double s = S[i][j]; S[i][j] = S[best][j]; S[best][j] = s; }
        for (int j = 0; j < N; j++) { const double y = Y[i][j]; Y[i][j] = Y[best][j]; Y[best][j] = y; }
        for (int k = i + 1; k < NU; k++) {
            const double factor = S[k][i] / S[i][i];
            for (int j = i; j < NU; j++) S[k][j] -= factor * S[i][j];
            for (int j = 0; j < N; j++) Y[k][j] -= factor * Y[i][j];
        }
    }
    for (int i = NU - 1; i >= 0; i--) {
        for (int k = i + 1; k < NU; k++) for (int j = 0; j < N; j++) Y[i][j] -= S[i][k] * Y[k][j];
        for (int j = 0; j < N; j++) Y[i][j] /= S[i][i];
    }
}

/* At one sample after another H = R + B'PB, G = H^-1 B'P and K = G A, then P = Q + A'P(A - BK). A is (N, N), B (N, NU)
   and Q (N, N), with the distances from a matrix and from a row to the next in numbers; R and P have no gaps. The gains
   (NU, N) are K or G, the matrices H are (NU, NU). */
void FN(riccati)(int64_t count, const double *A, int64_t A_next, int64_t A_row, const double *B, int64_t B_next,
                 int64_t B_row, const double *Q, int64_t Q_next, int64_t Q_row, const double *R, int64_t of_state,
                 double *P, double *gains, double *weights)
{
    double p[N][N];
    for (int i = 0; i < N * N; i++) p[i / N][i % N] = P[i];
    for (int64_t sample = 0; sample < count; sample++, A += A_next, B += B_next, Q += Q_next) {
        double G[NU][N] = {0}, S[NU][NU], K[NU][N] = {0}, closed[N][N], moved[N][N] = {0}, next[N][N];
        for (int k = 0; k < N; k++) for (int i = 0; i < NU; i++) for (int j = 0; j < N; j++)
            G[i][j] += B[k * B_row + i] * p[k][j];
        for (int i = 0; i < NU; i++) for (int j = 0; j < NU; j++) {
            S[i][j] = R[i * NU + j];
            for (int k = 0; k < N; k++) S[i][j] += G[i][k] * B[k * B_row + j];
        }
        for (int i = 0; i < NU * NU; i++) *weights++ = S[i / NU][i % NU];
        solve(S, G);
        for (int i = 0; i < NU; i++) for (int k = 0; k < N; k++) for (int j = 0; j < N; j++)
            K[i][j] += G[i][k] * A[k * A_row + j];
        for (int i = 0; i < N; i++) {
            for (int j = 0; j < N; j++) closed[i][j] = A[i * A_row + j];
            for (int k = 0; k < NU; k++) for (int j = 0; j < N; j++) closed[i][j] -= B[i * B_row + k] * K[k][j];
        }
        for (int i = 0; i < N; i++) for (int k = 0; k < N; k++) for (int j = 0; j < N; j++)
            moved[i][j] += p[i][k] * closed[k][j];
        for (int i = 0; i < N; i++) {
            for (int j = 0; j < N; j++) next[i][j] = Q[i * Q_row + j];
            for (int k = 0; k < N; k++) for (int j = 0; j < N; j++) next[i][j] += A[k * A_row + i] * moved[k][j];
        }
        for (int i = 0; i < N; i++) for (int j = 0; j < N; j++) p[i][j] = (next[i][j] + next[j][i]) / 2;
        for (int i = 0; i < NU * N; i++) *gains++ = of_state ? K[i / N][i % N] : G[i / N][i % N];
    }
    for (int i = 0; i < N * N; i++) P[i] = p[i / N][i % N];
}
