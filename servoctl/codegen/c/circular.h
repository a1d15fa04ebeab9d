/* Sine and cosine for a type of numbers: fdlibm's, after a reduction by three parts of pi/2; within 2 units in the last
   place. Before it, OF(name) names the functions of the type, and REAL and WHOLE are its numbers and integers. */

#define FAR 1e5 /* beyond it sin and cos are those of the C library */

/* r = a - n pi/2, where a is finite and not large, and in the last bits of the result the quadrant n. */
INLINE WHOLE OF(reduced)(REAL a, REAL *r)
{
    const REAL n_shifted = a * 0.63661977236758134308 + 6755399441055744.0, n = n_shifted - 6755399441055744.0;
    const REAL near = (a - n * 1.57079632673412561417e+00) - n * 6.07710050630396597660e-11;
    *r = near - n * 2.02226624879595063154e-21;
    return OF(bits)(n_shifted);
}

/* sin(r + quadrant pi/2), or the cosine if turns is 1, where |r| <= pi/4. */
INLINE REAL OF(of_reduced)(REAL r, WHOLE quadrant, int64_t turns)
{
    const REAL z = r * r, half = 0.5 * z, w = 1.0 - half;
    const REAL s = OF(select)(r == 0, r, r + z * r * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03
        + z * (-1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08
        + z * 1.58969099521155010221e-10))))));
    const REAL c = w + (z * z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03
        + z * (2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09
        + z * -1.13596475577881948265e-11))))));
    const WHOLE odd = (quadrant & 1) != 0;
    const REAL value = turns ? OF(select)(odd, s, c) : OF(select)(odd, c, s);
    return OF(value)(OF(bits)(value) ^ ((quadrant + turns) << 62 & INT64_MIN));
}

/* sin(a), or cos(a) if turns is 1, where a is finite and not large. */
INLINE REAL OF(turned)(REAL a, int64_t turns)
{
    REAL r;
    const WHOLE quadrant = OF(reduced)(a, &r);
    return OF(of_reduced)(r, quadrant, turns);
}

#undef OF
#undef REAL
#undef WHOLE
