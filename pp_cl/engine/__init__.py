"""The engine: trains and renders from arrays alone. It knows no folder, no file and no command.

Of the project it imports only errors and settings. In reading order:

step: the Trainer, which runs training step by step.
render: renders a model and computes gradients; it alone sets the order of the stages.
model: points in the cells of a grid, and the network.
camera, grid, views: define Camera, Grid and View.
raster/: points, project, pairs, weights, blend, depth: a module for each stage.
network/: layers is the U-Net on one page; unet launches it; tile_plan skips background.
layers/: the convolutions and the small layers; choice selects one for each layer.
training/: target, crops, loss, exposure; optim, state, schedule; smooth, prune.
device/: device and kernel build and launch kernels by name; buffers, launch, scan, host.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
