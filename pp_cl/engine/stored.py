"""What a checkpoint stores of a training, and how that is taken back: the names, shapes and dtypes
of the arrays, and the model's entries in the header.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pyopencl.array import Array

from pp_cl.engine.device.buffers import DeviceRows, Table
from pp_cl.engine.device.device import Device
from pp_cl.engine.grid import Grid
from pp_cl.engine.model import Model
from pp_cl.engine.network.layers import parameter_table, unet_layers
from pp_cl.engine.network.specular import Specular
from pp_cl.engine.network.unet import UNet
from pp_cl.engine.raster.points import (
    OPACITIES,
    SH_DEGREES,
    PointCloud,
    sh_blocks,
    stored_degree,
)
from pp_cl.engine.step import Trainer
from pp_cl.engine.training.exposure import MATRIX
from pp_cl.engine.training.optim import Optimiser
from pp_cl.engine.training.schedule import EMA_FROM
from pp_cl.engine.training.state import PointState
from pp_cl.settings import Config


def stored_table(
    config: Config,
    n: int,
    step: int | None,
    gains: int = 0,
    averaged: bool | None = None,
    *,
    has_specular: bool = False,
) -> Table:
    """The arrays in a checkpoint with n points after `step` steps; None: of a finished training.
    gains: number of views with gains. averaged: whether averages have begun; None: as is due by the
    steps in config, which a plan by minutes may have changed since. has_specular: whether the model
    has the specular layer.
    """
    degrees = SH_DEGREES[: config.points.sh_degree + 1]
    sh_dtype = np.float16 if step is None else np.float32
    network = parameter_table(unet_layers(config.network.widths, blocks=config.network.blocks))
    table: Table = {"points.ids": ((n,), np.uint32), "points.offset": ((n, 4), np.float32)}
    table["points.opacity"] = (n, OPACITIES), np.float32
    table |= {f"points.sh{d}": ((n, 2 * d + 1, 16), sh_dtype) for d in degrees}
    table |= {f"net.{name}": row for name, row in network.items()}
    if has_specular:
        table |= {f"specular.{name}": row for name, row in Specular.shapes().items()}
    if step is not None:
        table |= {f"moment.{kind}.{name}": row for name, row in network.items() for kind in "mv"}
        state = PointState.table(n)
        is_due = config.train.ema and step >= EMA_FROM * config.train.iterations
        if is_due if averaged is None else averaged:
            state |= {f"a.{name}": row for name, row in PointState.ema_table(n).items()}
            table |= {f"average.{name}": row for name, row in network.items()}
        table |= {f"state.{name}": row for name, row in state.items()}
    if gains:
        table["exposure"] = (gains, MATRIX + 3, 4), np.float32
    return table


# ---- the model


def model_header(model: Model) -> dict[str, Any]:
    """The entries of the header that load_model() needs in addition to the arrays."""
    header = {
        "grid": model.grid.header(),
        "depth_range": [float(x) for x in model.depth_range],
    }
    return header | ({"specular": True} if model.specular else {})


def model_arrays(model: Model) -> dict[str, DeviceRows]:
    """{name: array} of everything learned."""
    parameters = _network_parameters(model).items()
    networks = {name: DeviceRows(model.dev, array) for name, array in parameters}
    return cloud_arrays(model.dev, model.cloud) | networks


def load_model(
    dev: Device,
    header: dict[str, Any],
    arrays: dict[str, np.ndarray],
    net: UNet,
    *,
    degree: int,
) -> Model:
    """Make a Model from a checkpoint's header and arrays, which pp_cl/checkpoint.py has checked.
    Removes the arrays from `arrays` and writes the stored parameters to net.
    """
    grid, cloud = Grid.of_header(header["grid"]), load_cloud(dev, arrays, degree)
    specular = Specular(dev) if header.get("specular") else None
    model = Model(dev, grid, tuple(header["depth_range"]), cloud, net=net, specular=specular)
    for name, array in _network_parameters(model).items():
        dev.write(array, arrays.pop(name))
    return model


def cloud_arrays(dev: Device, cloud: PointCloud) -> dict[str, DeviceRows]:
    """{name: array} of the points; the SH by degree, (N, 1, 16), (N, 3, 16), (N, 5, 16)."""
    learned = {"ids": cloud.ids, "offset": cloud.offset, "opacity": cloud.opacity}
    stored = {name: DeviceRows(dev, array) for name, array in learned.items()}
    blocks = list(zip(cloud.blocks, cloud.sh, strict=True))
    for degree in range(stored_degree(cloud.sh) + 1):
        parts = [array for block, array in blocks if block.degree == degree]
        stored[f"sh{degree}"] = DeviceRows(dev, *parts)
    return {f"points.{name}": rows for name, rows in stored.items()}


def load_cloud(dev: Device, arrays: dict[str, np.ndarray], degree: int) -> PointCloud:
    """The points of a checkpoint's arrays, which are removed from `arrays`."""
    names = "ids", "offset", "opacity"
    ids, offset, opacity = (dev.upload(arrays.pop(f"points.{name}")) for name in names)
    by_degree = [arrays.pop(f"points.sh{d}") for d in SH_DEGREES[: degree + 1]]
    sh = []
    for block in sh_blocks(degree):
        start = block.first - block.degree**2  # within its degree
        sh.append(dev.upload(by_degree[block.degree][:, start : start + block.count]))
    return PointCloud(ids, offset, opacity, sh)


def _network_parameters(model):
    """{name: array} of the networks."""
    parameters = {f"net.{name}": array for name, array in model.net.parameters.items()}
    layer = model.specular.parameters if model.specular else {}
    return parameters | {f"specular.{name}": array for name, array in layer.items()}


# ---- the training's state


def training_arrays(trainer: Trainer) -> dict[str, DeviceRows]:
    """{name: array} of the model and of the training's state. Raises Diverged if a term of the loss
    of the last step is not finite.
    """
    trainer.check()
    exposure = trainer.exposure
    corrections = {"exposure": DeviceRows(trainer.dev, exposure.state)} if exposure else {}
    return model_arrays(trainer.model) | optimiser_arrays(trainer.optimiser) | corrections


def restore_training(
    trainer: Trainer,
    step: int,
    arrays: dict[str, np.ndarray],
    begun: int,
    exposed: str = "",
    progress: float = 0.0,
) -> None:
    """Resume after `step` steps with a checkpoint's training state, which is removed from `arrays`;
    the model must be loaded already. A finished training stores no such state: its moments start
    anew, and so do its EMA, if it is due, and the estimates of colours. exposed: Exposure.kind.
    progress:
    after these steps.
    """
    trainer.start_at(step, begun, progress)
    train = trainer.config.train
    if arrays:
        restore_optimiser(trainer.optimiser, arrays)
        if "exposure" not in arrays:
            trainer.exposure = None
        elif trainer.exposure:
            trainer.exposure.restore(exposed, arrays.pop("exposure"))
        return
    if trainer.exposure:
        trainer.exposure.restore(exposed)
    if train.ema and trainer.progress >= EMA_FROM:
        trainer.optimiser.update_ema(1.0)


def optimiser_arrays(optimiser: Optimiser) -> dict[str, DeviceRows]:
    """{name: array} of the moments, the averages and the state of the points."""
    net, split = optimiser.model.net, optimiser.model.net.split
    of_network: dict[str, Array] = {}
    moments = {kind: split(array) for kind, array in optimiser.moments.items()}
    for name in net.parameters:
        of_network |= {f"moment.{kind}.{name}": parts[name] for kind, parts in moments.items()}
    for array in optimiser.averages.values():
        of_network |= {f"average.{name}": part for name, part in split(array).items()}
    arrays = state_arrays(optimiser.state) | of_network
    return {name: DeviceRows(optimiser.dev, array) for name, array in arrays.items()}


def restore_optimiser(optimiser: Optimiser, arrays: dict[str, np.ndarray]) -> None:
    """Take the state, as optimiser_arrays() names it, out of the arrays of a checkpoint."""
    dev, net, averages = optimiser.dev, optimiser.model.net, optimiser.state.averages
    for name, parameter in optimiser.model.cloud.learned().items():
        if f"state.a.{name}" in arrays:
            stored = arrays.pop(f"state.a.{name}")
            averages[name] = dev.upload(stored.reshape(parameter.shape))
    whole = {f"moment.{kind}": array for kind, array in optimiser.moments.items()}
    if any(name.startswith("average.") for name in arrays):
        optimiser.averages = {"network": dev.zeros(net.all_parameters.shape)}
        whole["average"] = optimiser.averages["network"]
    for kind, array in whole.items():
        for name, part in net.split(array).items():
            dev.write(part, arrays.pop(f"{kind}.{name}"))
    for name, array in state_arrays(optimiser.state).items():
        if not name.startswith("state.a."):
            dev.write(array, arrays.pop(name))


def state_arrays(state: PointState) -> dict[str, Array]:
    """{name: array} of the training state of the points."""
    averages = {f"a.{name}": array for name, array in state.averages.items()}
    return {f"state.{name}": array for name, array in (state.arrays | averages).items()}
