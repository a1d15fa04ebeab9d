"""The adaptive method of Dormand and Prince of order 8, with dense output of order 7: DOP853 as in scipy, to the bit.

Importing `scipy.integrate` takes longer than most motions. Source: Hairer, Nørsett and Wanner, Solving Ordinary
Differential Equations I, II.5, II.6 and II.10, and the coefficients of their program DOP853.
"""

import numpy as np

N_STAGES, METHOD_ORDER = 12, 8
SAFETY, MIN_FACTOR, MAX_FACTOR = 0.9, 0.2, 10.0  # of the next step, relative to the optimal one and to the last one
TOO_SMALL = "Required step size is less than spacing between numbers."

# fmt: off
# Rows 1 to 15 of A: eleven stages, the result, and three stages of the dense output.
_ROWS = (
    (0.05260015195876773,),
    (0.0197250569845379, 0.0591751709536137),
    (0.02958758547680685, 0, 0.08876275643042054),
    (0.2413651341592667, 0, -0.8845494793282861, 0.924834003261792),
    (0.037037037037037035, 0, 0, 0.17082860872947386, 0.12546768756682242),
    (0.037109375, 0, 0, 0.17025221101954405, 0.06021653898045596, -0.017578125),
    (0.03709200011850479, 0, 0, 0.17038392571223998, 0.10726203044637328, -0.015319437748624402, 0.008273789163814023),
    (0.6241109587160757, 0, 0, -3.3608926294469414, -0.868219346841726, 27.59209969944671, 20.154067550477894,
     -43.48988418106996),
    (0.47766253643826434, 0, 0, -2.4881146199716677, -0.590290826836843, 21.230051448181193, 15.279233632882423,
     -33.28821096898486, -0.020331201708508627),
    (-0.9371424300859873, 0, 0, 5.186372428844064, 1.0914373489967295, -8.149787010746927, -18.52006565999696,
     22.739487099350505, 2.4936055526796523, -3.0467644718982196),
    (2.273310147516538, 0, 0, -10.53449546673725, -2.0008720582248625, -17.9589318631188, 27.94888452941996,
     -2.8589982771350235, -8.87285693353063, 12.360567175794303, 0.6433927460157636),
    (0.054293734116568765, 0, 0, 0, 0, 4.450312892752409, 1.8915178993145003, -5.801203960010585, 0.3111643669578199,
     -0.1521609496625161, 0.20136540080403034, 0.04471061572777259),
    (0.056167502283047954, 0, 0, 0, 0, 0, 0.25350021021662483, -0.2462390374708025, -0.12419142326381637,
     0.15329179827876568, 0.00820105229563469, 0.007567897660545699, -0.008298),
    (0.03183464816350214, 0, 0, 0, 0, 0.028300909672366776, 0.053541988307438566, -0.05492374857139099, 0, 0,
     -0.00010834732869724932, 0.0003825710908356584, -0.00034046500868740456, 0.1413124436746325),
    (-0.42889630158379194, 0, 0, 0, 0, -4.697621415361164, 7.683421196062599, 4.06898981839711, 0.3567271874552811, 0,
     0, 0, -0.0013990241651590145, 2.9475147891527724, -9.15095847217987),
)
_NODES = (
    0, 0.05260015195876773, 0.0789002279381516, 0.1183503419072274, 0.2816496580927726, 0.3333333333333333, 0.25,
    0.3076923076923077, 0.6512820512820513, 0.6, 0.8571428571428571, 1.0, 1.0, 0.1, 0.2, 0.7777777777777778,
)
# Error estimates of orders 3 and 5, by stages and the rate at the end.
_E3 = (
    -0.18980075407240762, 0, 0, 0, 0, 4.450312892752409, 1.8915178993145003, -5.801203960010585, -0.4226823213237919,
    -0.1521609496625161, 0.20136540080403034, 0.02265179219836082, 0,
)
_E5 = (
    0.01312004499419488, 0, 0, 0, 0, -1.2251564463762044, -0.4957589496572502, 1.6643771824549864,
    -0.35032884874997366, 0.3341791187130175, 0.08192320648511571, -0.022355307863886294, 0,
)
# Coefficients 3 to 6 of the dense output, by stages.
_DENSE = (
    (-8.428938276109013, 0, 0, 0, 0, 0.5667149535193777, -3.0689499459498917, 2.38466765651207, 2.117034582445028,
     -0.871391583777973, 2.2404374302607883, 0.6315787787694688, -0.08899033645133331, 18.148505520854727,
     -9.194632392478356, -4.436036387594894),
    (10.427508642579134, 0, 0, 0, 0, 242.28349177525817, 165.20045171727028, -374.5467547226902, -22.113666853125306,
     7.733432668472264, -30.674084731089398, -9.332130526430229, 15.697238121770845, -31.139403219565178,
     -9.35292435884448, 35.81684148639408),
    (19.985053242002433, 0, 0, 0, 0, -387.0373087493518, -189.17813819516758, 527.8081592054236, -11.57390253995963,
     6.8812326946963, -1.0006050966910838, 0.7777137798053443, -2.778205752353508, -60.19669523126412,
     84.32040550667716, 11.99229113618279),
    (-25.69393346270375, 0, 0, 0, 0, -154.18974869023643, -231.5293791760455, 357.6391179106141, 93.40532418362432,
     -37.45832313645163, 104.0996495089623, 29.8402934266605, -43.53345659001114, 96.32455395918828,
     -39.17726167561544, -149.72683625798564),
)
# fmt: on

A = np.array([[*row, *[0.0] * (16 - len(row))] for row in ((), *_ROWS)])
B, C, E3, E5, D = A[N_STAGES, :N_STAGES], *map(np.array, (_NODES, _E3, _E5, _DENSE))


class DormandPrince8:
    """One integration; like the solvers of scipy it has t, y, status and step().

    Parameters
    ----------
    rates : callable
        (t, y) -> y' (n,).
    t : float
    y : (n,) array
    bound : float
        End of the integration.
    rtol : float
    atol : float or (n,) array
    first_step : float, optional
    """

    njev = nlu = 0

    def __init__(self, rates, t, y, bound, rtol, atol, first_step=None):
        self._rates, self.t_bound, self.tolerances, self.nfev = rates, bound, (rtol, atol), 0
        self.t, self.y, self.direction = t, np.array(y, dtype=float), np.sign(bound - t) or 1.0
        self.status, self.t_old, self.y_old = "running", None, None
        self._stages = np.empty((len(A), len(self.y)))
        self.f = self.fun(t, self.y)
        self._length = self._first_length() if first_step is None else first_step

    def fun(self, t, y):
        """The rates (n,), counted."""
        self.nfev += 1
        return self._rates(t, y)

    def _first_length(self):
        """A length at which the error estimate of order 7 is about 0.01 of its tolerance (Hairer, II.4)."""
        span, (rtol, atol) = abs(self.t_bound - self.t), self.tolerances
        if not self.y.size:
            return np.inf
        if span == 0.0:
            return 0.0
        scale = atol + np.abs(self.y) * rtol
        size, speed = _norm(self.y / scale), _norm(self.f / scale)
        probe = min(1e-6 if size < 1e-5 or speed < 1e-5 else 0.01 * size / speed, span)
        h = probe * self.direction
        bend = _norm((self.fun(self.t + h, self.y + h * self.f) - self.f) / scale) / probe
        straight = speed <= 1e-15 and bend <= 1e-15
        length = max(1e-6, probe * 1e-3) if straight else (0.01 / max(speed, bend)) ** (1 / METHOD_ORDER)
        return min(100 * probe, length, span)

    def step(self):
        """One step, whose error estimate meets the tolerances; a message where none is short enough."""
        if not self.y.size or self.t == self.t_bound:
            self.t_old, self.t, self.status = self.t, self.t_bound, "finished"
            return None
        least, rejected = 10 * abs(np.nextafter(self.t, self.direction * np.inf) - self.t), False
        length = max(self._length, least)
        while length >= least:
            end = self.t + length * self.direction
            end = self.t_bound if self.direction * (end - self.t_bound) > 0 else end
            h = end - self.t
            y, f = self._tried(h)
            error = self._error(y, h)
            factor = MAX_FACTOR if error == 0 else SAFETY * error ** (-1 / METHOD_ORDER)
            if error < 1:
                self._length = abs(h) * min(1.0 if rejected else MAX_FACTOR, factor)
                self.t_old, self.y_old, self.t, self.y, self.f = self.t, self.y, end, y, f
                self.status = "finished" if self.direction * (end - self.t_bound) >= 0 else "running"
                return None
            length, rejected = abs(h) * max(MIN_FACTOR, factor), True
        self.status = "failed"
        return TOO_SMALL

    def _tried(self, h):
        """The state after a step, and its rates."""
        k = self._stages
        k[0] = self.f
        for s in range(1, N_STAGES):
            k[s] = self.fun(self.t + C[s] * h, self.y + np.dot(k[:s].T, A[s, :s]) * h)
        y = self.y + h * np.dot(k[:N_STAGES].T, B)
        k[N_STAGES] = f = self.fun(self.t + h, y)
        return y, f

    def _error(self, y, h):
        """The error estimate relative to the tolerances, from those of orders 5 and 3."""
        rtol, atol = self.tolerances
        scale = atol + np.maximum(np.abs(self.y), np.abs(y)) * rtol
        fifth, third = (np.linalg.norm(np.dot(self._stages[: N_STAGES + 1].T, e) / scale) ** 2 for e in (E5, E3))
        return 0.0 if fifth == third == 0.0 else abs(h) * fifth / np.sqrt((fifth + 0.01 * third) * len(scale))

    def dense_output(self):
        """The state as a function of times within the last step."""
        if self.t == self.t_old or not self.y.size:
            return lambda t, y=self.y: y if np.ndim(t) == 0 else np.repeat(y[:, None], len(t), axis=1)
        k, start, h = self._stages, self.y_old, self.t - self.t_old
        for s in range(N_STAGES + 1, len(A)):
            k[s] = self.fun(self.t_old + C[s] * h, start + np.dot(k[:s].T, A[s, :s]) * h)
        change = self.y - start
        terms = [change, h * k[0] - change, 2 * change - h * (self.f + k[0]), *(h * np.dot(D, k))]
        return Interpolant(self.t_old, h, start, terms)


class Interpolant:
    """The dense output of a step: a polynomial of degree 7."""

    def __init__(self, t, h, y, terms):
        self.t, self.h, self.y, self.terms = t, h, y, terms

    def __call__(self, t):
        """The state (n,) at a time, or (n, N) at times (N,)."""
        x = (np.asarray(t) - self.t) / self.h
        x = x[..., None]
        y = np.zeros((*np.shape(t), len(self.y)))
        for i, term in enumerate(reversed(self.terms)):
            y += term
            y *= x if i % 2 == 0 else 1 - x
        return (y + self.y).T


def _norm(x):
    """Root mean square."""
    return np.linalg.norm(x) / x.size**0.5
