
/* Row k of the schedule. */
static void schedule(int k, double *row)
{
    for (int i = 0; i < WIDTH; i++) row[i] = table[WIDTH * k + i];
}
