"""Signals of many motions by name, computed when they are read."""

from collections.abc import Mapping

import numpy as np

from servoctl.model.equations import signal_groups
from servoctl.model.following import places_of
from servoctl.model.jets import extended, jet_names_to, with_highest
from servoctl.run import ByName, Run

MOST_POINTS = 100_000  # of motions and instants at which signals are evaluated in one call


class Signals(ByName, Mapping):
    """Signals of N motions at K instants, (K, N) arrays by the names that a `Run` of one motion has.

    `t` has the instants [s], then the end of the motions if that is none of them; `states` (n_x, K or K + 1, N) are
    those at `t`, NaN for motions that ended early, and `parameters` are (n_p, N) in SI. `level` is the highest order of
    the jets, and `runs` are motions that have models of their own, by index; `models` follow the paths of each motion.
    """

    def __init__(self, models, model, t, count, states, parameters, level, runs):
        self._models, self._model, self._t, self._count, self._runs = models, model, t, count, runs
        self._states, self._parameters = states, parameters
        self._jet_names = jet_names_to(model, model.nq + level * model.n)
        self._values = dict(zip(model.state_names, states, strict=True))
        self.names = tuple(dict.fromkeys([*self._jet_names, *signal_groups(model.reduction)]))

    def __getitem__(self, name):
        return self._along(name)[: self._count]

    def final(self, name):
        """The values of a signal at the end of the motions, (N,)."""
        return self._along(name)[-1]

    def _along(self, name):
        if name not in self._values:
            self._values.update(self._computed(name))
        return self._values[name]

    def _computed(self, name):
        """The signals (K, N) of a group by name, evaluated for all motions at once where their jets suffice."""
        model = self._model
        top, kind = model.jet_names[len(model.state_names) :], signal_groups(model.reduction).get(name)
        names, f = model.signals(kind) if kind else (top, None)
        at_once = name in top or f is not None and f.n_x <= len(model.jet_names)
        each = np.arange(self._states.shape[2])
        common = each[~np.isin(each, list(self._runs))] if at_once else each[:0]
        values = np.full((len(names) if at_once else 1, *self._states.shape[1:]), np.nan)
        for part in np.array_split(common, -(-len(common) * len(self._t) // MOST_POINTS)) if len(common) else ():
            values[:, :, part] = self._evaluated(f, part)
        values[:, np.isnan(self._states).any(axis=0)] = np.nan
        names = names if at_once else (name,)
        for i in np.setdiff1d(each, common).tolist():
            run = self._run(i)
            if run is not None:
                values[:, :, i] = [run[name] for name in names]
        return zip(names, values, strict=True)

    def _evaluated(self, f, part):
        """A function of the jets, or the highest of these, (n, K, N) for some motions."""
        model, count = self._model, len(part)
        t, numbers = np.repeat(self._t, count), self._parameters[:, part]
        p = np.tile(np.vstack([places_of([self._models[i] for i in part]), numbers]), len(self._t))
        jets = with_highest(model, t, self._states[:, :, part].reshape(len(self._states), -1), p)
        y = jets[len(self._states) :] if f is None else f.grid(t, jets[: f.n_x], p)
        return y.reshape(len(y), len(self._t), count)

    def _run(self, i):
        """The run of a motion; None if it ended early."""
        states = self._states[:, :, i]
        if i in self._runs or np.isnan(states).any():
            return self._runs.get(i)
        values = dict(zip(self._model.numbers, self._parameters[:, i].tolist(), strict=True))
        model = self._models[i].with_parameters(**values)
        jets = with_highest(model, self._t, states)
        if len(self._jet_names) > len(jets):
            jets = extended(model, self._t, jets, len(self._jet_names))
        return Run(self._t, jets, self._jet_names, model)
