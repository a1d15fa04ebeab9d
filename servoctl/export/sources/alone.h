/* Sizes, functions and tables of an exported file, for compilers that see one file of this folder alone. */
#include <math.h>

#include "../../codegen/c/piece.h"

#define N 2
#define NQ 2
#define NX 4
#define NY 8
#define NJ 6
#define FIRST 2
#define NU 2
#define NZ 1
#define NO 3
#define ITERATIONS 30
#define TOLERANCE 1e-13
#define STALLED 0.0
#define T0 0.0
#define RATE 100.0
#define ROWS 2
#define WIDTH 3
#define KNOTS 2
#define NP 3
#define NALL 8
#define NREFERENCES 1
#define MOST 4
#define OPEN 3

void path(double t, const double *x, const double *p, double *y);
void rates(double t, const double *x, const double *p, double *y);
void actuation(double t, const double *x, const double *p, double *y);
void law(double t, const double *x, const double *p, double *y);
static const int knot[KNOTS] = {0, 1};
static const double z0[NZ] = {0}, table[2 * ROWS * WIDTH] = {0};
static const Path paths[NREFERENCES] = {{0, 0, 0, 0, 0, 0, 0, 0, 0}};
