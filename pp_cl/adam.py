"""Adam, dense for every parameter, and exponential averages of the weights.

Every row moves in every step by its momentum, seen or not: torch's semantics, which the published rates assume.
"""

import math

BETA1, BETA2 = 0.9, 0.999  # Kingma & Ba 2015


def _step_arguments(step, rate, eps, beta1, beta2):
    """The kernels' scalars: rate (m/c1) / (sqrt(v/c2) + eps) is (rate sqrt(c2)/c1) m / (sqrt(v) + eps sqrt(c2))."""
    root = math.sqrt(1 - beta2**step)
    return {"decay1": 1 - beta1, "decay2": 1 - beta2, "rate": rate * root / (1 - beta1**step), "eps": eps * root}


def _same_shape(**arrays):
    shapes = {name: array.shape for name, array in arrays.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(f"arrays of one shape wanted: {shapes}")


def adam_update(dev, parameter, grad, m, v, step, rate, eps, beta1=BETA1, beta2=BETA2, low=-math.inf, high=math.inf):
    """One Adam step of `parameter`, in place, then a clamp to [low, high].

    parameter, grad, m, v: float32 arrays of one shape, any; m and v start as zeros. step: from 1 on.
    Raises ValueError when the shapes differ.
    """
    _same_shape(parameter=parameter, grad=grad, m=m, v=v)
    dev.program("adam").launch("adam_update", -(-parameter.size // 16), n=parameter.size, grad=grad, parameter=parameter,
                               m=m, v=v, low=low, high=high, **_step_arguments(step, rate, eps, beta1, beta2))


def adam_sh_update(dev, grid, camera, ids, grad_point_features, sh, m, v, step, rate, eps, beta1=BETA1, beta2=BETA2):
    """One Adam step of the SH coefficients of one degree, in place.

    grid: (8,) of Grid.packed(). camera: (20,) of the view the gradient belongs to. ids: (N,) uint32 grid ids.
    grad_point_features: (N, 16) gradient of the points' features in that view, 0 for unseen points.
    sh, m, v: (N, 2*degree + 1, 16) with degree 0, 1 or 2. step: from 1 on. Raises ValueError for another number.
    """
    if sh.shape[1] not in (1, 3, 5):
        raise ValueError(f"coefficients of one degree wanted: {sh.shape}")
    program = dev.program("adam", DEGREE=sh.shape[1] // 2)
    program.launch("adam_sh_update", len(sh), n=len(sh), grid=grid, camera=camera, ids=ids, sh=sh, m=m, v=v,
                   grad_point_features=grad_point_features, **_step_arguments(step, rate, eps, beta1, beta2))


def ema_update(dev, average, parameter, weight):
    """Move an average, in place: average += weight * (parameter - average). A weight of 1 copies, whatever it held.

    average, parameter: float32 arrays of one shape, any. Raises ValueError when the shapes differ.
    """
    _same_shape(average=average, parameter=parameter)
    if weight == 1:
        dev.copy(average, parameter)
        return
    dev.program("adam").launch("ema_update", -(-parameter.size // 16), n=parameter.size, weight=weight,
                               parameter=parameter, average=average)
