"""Exports a run to other programs: videos, point clouds, meshes, a web page, rendered views."""

QUICK, BEST = "quick", "best"
# {quality of a splat: (steps that fit it, voxel sizes of the cells whose points begin as one, 0:
# each alone)}
QUALITIES = {QUICK: (1500, 1.25), BEST: (7000, 0.0)}
SCENE, VIEWER = AXES = "scene", "viewer"
SPLATS, POINTS = ("splat", "splat-spz", "splat-glb"), ("ply", "glb")
# {format of coordinates: whose axes they have, unless others are asked for}
AXES_OF = dict.fromkeys((*SPLATS, "textured"), VIEWER) | dict.fromkeys((*POINTS, "mesh"), SCENE)
# {format: (name below RUN/export, where no path is given; suffixes of the file, none of a folder;
# what it is)}
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
    "ply": ("cloud.ply", (".ply",), "the visible points with colour and everything learned"),
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
