"""The engine: trains and renders from arrays alone. It knows no folder, no file and no command.

Of the project it imports errors and settings, nothing else. In the order of reading:

step: one step of training, and what is due between steps.
render: from a model and a camera to an image and back, the one place with the order of the stages.
model: points in the cells of a grid, and the network.
camera, grid, views: what these are.
raster/: points, project, pairs, weights, blend, depth: a stage each, beside its kernels.
network/: layers is the U-Net on one page; unet launches it; tile_plan leaves out background.
layers/: the convolutions and the small layers; choice says which is taken where.
training/: target, crops, loss, exposure; optim, state, schedule; smooth, prune.
device/: device and kernel build and launch by name; buffers, launch, scan, host.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
