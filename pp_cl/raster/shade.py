"""View-dependent features of points from their spherical harmonics coefficients."""

from pp_cl.raster.sh import SH_BLOCKS


def shade_forward(dev, view, point_camera, seen, sh, point_features):
    """Write the rows `seen` of point_features (N,16).

    view: (20) packed camera. point_camera: (N,4) from project; the direction of a point is
    normalize(point - eye) in world axes. seen: (S) uint32. sh: the coefficients, the arrays of
    points.SH_BLOCKS up to one degree's end.
    """
    dev.program("raster/shade", DEGREE=_degree(sh)).launch(
        "shade_forward",
        seen.size,
        s=seen.size,
        seen=seen,
        camera=view,
        point_camera=point_camera,
        point_features=point_features,
        **_by_block("sh", point_camera, sh),
    )


def shade_backward(dev, view, point_camera, grad_point_features, grad_sh):
    """Write grad_sh, arrays as in shade_forward, from grad_point_features (N,16)."""
    n = point_camera.shape[0]
    dev.program("raster/shade", DEGREE=_degree(grad_sh)).launch(
        "shade_backward",
        n,
        n=n,
        camera=view,
        point_camera=point_camera,
        grad_point_features=grad_point_features,
        **_by_block("grad_sh", point_camera, grad_sh),
    )


def _degree(arrays):
    """The degree up to which the arrays go. Raises ValueError where they end within one."""
    last, *following = SH_BLOCKS[len(arrays) - 1 : len(arrays) + 1]
    if following and following[0].degree == last.degree:
        raise ValueError(f"{len(arrays)} arrays of coefficients end within degree {last.degree}")
    return last.degree


def _by_block(name, point_camera, arrays):
    """{name0, name1, name4, name7: array}; the first stands in for absent ones. Raises ValueError
    on a wrong shape.
    """
    for block, array in zip(SH_BLOCKS, arrays, strict=False):
        expected = (point_camera.shape[0], block.count, 16)
        if array.shape != expected:
            raise ValueError(f"{name}{block.first} has shape {array.shape}, expected {expected}")
    return {
        f"{name}{block.first}": arrays[i if i < len(arrays) else 0]
        for i, block in enumerate(SH_BLOCKS)
    }
