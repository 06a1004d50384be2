"""Makes a scene with cameras, box and masks from photographs or a video of an object."""

# {stage: its result}, in the order of the stages
STAGES = {
    "frames": "upright photographs, the sharpest frames of a video",
    "features": "what can be found again in other images",
    "matches": "pairs of images that show the same",
    "poses": "where each image was taken",
    "images": "the photographs without the distortion of their lens",
    "box": "what the cameras look at",
    "masks": "the object in each image",
    "scene": "transforms.json, COLMAP's model in sparse/0, points.ply",
}
