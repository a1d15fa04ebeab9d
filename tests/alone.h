/* A unit of small sizes, by which each C file of servoctl/codegen/c compiles alone. */
#define NAME example
#define NX 4
#define NP 3
#define NY 13
#define PROJECTED
#define WIDE
#define WORK 8

#define CORRECTIONS 30
#define CORRECTED 1e-13
#define ROUNDING 0x1p-52
#define QUADRATIC 1e-8
#define CONTRACTION 0.25
#define FOLLOWED 0.01
#define STEADY 0.25
#define SHORTEST 0x1p-32
#define TERMS 4
#define LAST_TERM 0.1
#define BEND 0.344
#define REST 1000

/* newton.c */
#define PIVOTS 1

/* taylor.c */
#define NQ 2
#define N 2
#define TOP 2
#define LAST 4
#define PLAIN 1
#define FREE {1, 1}
#define SETTLED

/* many.c, plans.c */
#define DEGRADED 0.02
#define NEGLIGIBLE 1e-7
#define FAR_OFF 30.0

/* machine.c */
#define WIDTH 64
#define INPUT_ 1
#define CONST_ 2
#define OUTPUT_ 3
#define OPERATIONS EACH(4, a + b) EACH(5, sqrt(a))

/* batch.c */
#define VECTORS 2
#define LOOKED 64
#define NU 2
#define NC 2
#define NW 2
#define NV 1
#define ND 1
#define NO 3
#define NM 4
#define NZ 1
#define NL 2
#define NS 1
#define NR 2
#define NT 8
#define MEASURED {0, 1, 2, 3}

/* allocation.c */
#define NROW 5
#define NSIG 1
#define NZ_LAW 1
#define NK 2
#define NJ 1
#define NI 1
#define INTEGRATORS {0}
#define CORRECTED_BY
#define QP_STEPS 100
#define QP_MET 1e-10
#define QP_DEPENDENT 1e-9
#define QP_TINY 1e-300
#define MET 1e-7
#define GIVEN_WAY 1e-6

#include "lanes.h"

#define DECLARED(name, number) \
    void name(number t, const number *restrict x, const number *restrict p, number *restrict y);
DECLARED(example, double)
DECLARED(example_project, double)
DECLARED(example_settled, double)
DECLARED(example_jacobian, double)
DECLARED(example_wide, W)
DECLARED(off_manifold, W)
DECLARED(numbers, W)
DECLARED(change, W)
#define PHASE(name, number) \
    void name(number t, const number *restrict x, const number *restrict p, number *restrict y, number *restrict w);
PHASE(example_instant, double)
PHASE(example_correction, double)
PHASE(example_rest, double)
PHASE(example_still, double)
PHASE(example_moving, double)
PHASE(expansion_still, W)
PHASE(expansion_moving, W)
PHASE(example_wide_instant, W)
PHASE(example_wide_correction, W)
PHASE(example_wide_rest, W)
void law(W t, const W *restrict x, const double *restrict p, W *restrict y);
void signals(W t, const W *restrict x, const double *restrict p, W *restrict y);
void rates_of_block(W t, const W *const x[], const W *const p[], W (*y)[NX + 1]);
DECLARED(unlimited, double)
DECLARED(effects, double)
