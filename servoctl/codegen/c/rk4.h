/* One Runge-Kutta step of order 4 of x from t to t + h, inside a function that has these arrays, k1 = x' at t, k2, k3,
   k4 and z. Before it, EACH runs over the states, AT(x) is the one it is at, and RATES(stage, t, x, k) computes k = x'
   under the disturbances at the start (0), the middle (1) or the end (2) of the step. */
const double half = h / 2, sixth = h / 6;
EACH AT(z) = AT(x) + half * AT(k1);
RATES(1, t + half, z, k2);
EACH AT(z) = AT(x) + half * AT(k2);
RATES(1, t + half, z, k3);
EACH AT(z) = AT(x) + h * AT(k3);
RATES(2, t + h, z, k4);
EACH AT(x) += sixth * (AT(k1) + 2.0 * (AT(k2) + AT(k3)) + AT(k4));
