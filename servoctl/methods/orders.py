"""A motion ends where a row takes another order than the one that it was derived with."""

from servoctl.errors import ServoError
from servoctl.model.following import instants_of
from servoctl.model.variants import derived_near
from servoctl.reduction.orders import other_order


def end_where_orders_change(motion):
    """Cut a motion in place before the first sample at which a row has another order, and set the error as its stop."""
    for model, t, jets in motion.by_piece():
        if not model.reduction.orders:  # which rest on no slope
            continue
        k, name = model.reduction.orders.first_change(instants_of(model, t), jets, model.parameters)
        if k is not None:
            motion.end_before(t[k], _other_order(model, name, float(t[k]), jets[:, k]))
            return


def _other_order(model, name, t, jets):
    """The error of a row whose order changes at t and jets."""
    try:
        free = derived_near(model, t, jets[: len(model.jet_names)]).free
    except ServoError as error:
        free = error.details.get("free")
    return other_order(name, t, free, model.free)
