
/* Derivatives 0 .. most of the references at time t, those of all references before the next ones; NAN where the path
   says nothing of this instant. */
static void references(double t, int most, double *jets)
{
    for (int i = 0; i < NREFERENCES; i++) {
        const Path *path = &paths[i];
        const int open = (t < path->breaks[0] && path->before == OPEN)
                      || (t > path->breaks[path->pieces] && path->after == OPEN);
        const Piece piece = path_at(path, t, t);
        double r[MOST + 1] = {0}, factor = open ? NAN : 1.0;
        for (int64_t j = piece.size - 1; j >= 0; j--) {
            for (int k = most; k > 0; k--) r[k] = r[k] * piece.tau + r[k - 1];
            r[0] = r[0] * piece.tau + piece.c[j];
        }
        for (int k = 0; k <= most; k++) {
            jets[k * NREFERENCES + i] = r[k] * factor;
            factor *= (double)(k + 1) * piece.scale;
        }
        if (fabs(piece.tau) == 1) path_rest(path, &piece, most, NREFERENCES, jets + i);
    }
}
