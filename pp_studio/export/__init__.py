"""Exports a run to other programs: videos, point clouds, meshes, a web page, rendered views."""

QUICK, BEST = "quick", "best"
# {quality of a splat: (steps of its fit, size in voxels of the cells whose points begin as one
# Gaussian, 0: each point alone)}
QUALITIES = {QUICK: (1500, 1.25), BEST: (7000, 0.0)}
SCENE, VIEWER = AXES = "scene", "viewer"
SPLATS, POINTS = ("splat", "splat-spz", "splat-glb"), ("ply", "glb")
# {format of coordinates: the axes that it uses by default}
AXES_OF = dict.fromkeys((*SPLATS, "textured"), VIEWER) | dict.fromkeys((*POINTS, "mesh"), SCENE)
# {format: (default name below RUN/export; suffixes of the file, none if it is a folder; what it
# is)}
FORMATS: dict[str, tuple[str, tuple[str, ...], str]] = {
    "splat": (
        "splat.ply",
        (".ply",),
        "the .ply of 3D Gaussian splatting, for SuperSplat, Blender and all other viewers",
    ),
    "splat-spz": (
        "splat.spz",
        (".spz",),
        "the same in a tenth of the bytes, for Scaniverse, Spark, PlayCanvas and Babylon.js",
    ),
    "splat-glb": ("splat.glb", (".glb",), "the same as glTF (KHR_gaussian_splatting)"),
    "ply": ("cloud.ply", (".ply",), "the visible points with colour, opacity, radius and SH"),
    "glb": ("cloud.glb", (".glb",), "the coloured points"),
    "mesh": (
        "mesh.ply",
        (".ply", ".glb", ".obj", ".stl"),
        "the surface with coloured vertices, .ply, .glb, .obj or .stl (without colours) by --out",
    ),
    "textured": (
        "model.glb",
        (".glb", ".obj"),
        "the surface with few faces and a texture, .glb, or .obj with .mtl and .png by --out",
    ),
    "html": (
        "view.html",
        (".html",),
        "one page that a browser draws without network or installation",
    ),
    "gallery": ("gallery", (), "a folder of such pages, one a run, with an index and stills"),
    "scene": (
        "scene",
        (),
        "renderings of the train and test views as a NeRF-synthetic folder",
    ),
}
