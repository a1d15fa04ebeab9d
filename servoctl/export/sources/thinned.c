
/* Row k of the schedule: cubic polynomials between the rows that are stored, with their slopes. */
static void schedule(int k, double *row)
{
    int low = 0, high = KNOTS - 1;
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (knot[middle] <= k) low = middle;
        else high = middle;
    }
    const double *a = table + 2 * WIDTH * low, *b = table + 2 * WIDTH * high;
    const double h = (double)(knot[high] - knot[low]), s = h > 0 ? (double)(k - knot[low]) / h : 0, r = 1 - s;
    for (int i = 0; i < WIDTH; i++) {
        row[i] = a[i] + s * s * (1 + 2 * r) * (b[i] - a[i]); /* constants to the last digit */
        row[i] += h * s * r * (r * a[WIDTH + i] - s * b[WIDTH + i]);
    }
}
