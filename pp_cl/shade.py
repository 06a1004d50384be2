"""View-dependent features of points from their spherical harmonics coefficients."""


def shade_forward(dev, view, point_camera, seen, sh, point_features):
    """Write the rows `seen` of point_features (N,16).

    view: (20) packed camera. point_camera: (N,4) from project; the direction of a point is normalize(point - eye) in world
    axes. seen: (S) uint32. sh: the coefficients by degree, the first one to three of (N,1,16), (N,3,16), (N,5,16).
    """
    dev.program("shade", DEGREE=len(sh) - 1).launch(
        "shade_forward", seen.size, s=seen.size, seen=seen, camera=view, point_camera=point_camera,
        point_features=point_features, **_by_degree("sh", point_camera, sh))


def shade_backward(dev, view, point_camera, grad_point_features, grad_sh):
    """Write grad_sh, by degree as in shade_forward, from grad_point_features (N,16)."""
    n = point_camera.shape[0]
    dev.program("shade", DEGREE=len(grad_sh) - 1).launch(
        "shade_backward", n, n=n, camera=view, point_camera=point_camera, grad_point_features=grad_point_features,
        **_by_degree("grad_sh", point_camera, grad_sh))


def _by_degree(name, point_camera, arrays):
    """{name0, name1, name2: array}; the first stands in for absent degrees. Raises ValueError on a wrong shape."""
    for degree, array in enumerate(arrays):
        expected = (point_camera.shape[0], 2 * degree + 1, 16)
        if array.shape != expected:
            raise ValueError(f"{name}{degree} has shape {array.shape}, expected {expected}")
    return {f"{name}{degree}": arrays[degree if degree < len(arrays) else 0] for degree in range(3)}
