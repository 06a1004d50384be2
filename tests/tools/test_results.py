from tools import docs_tables
from tools import results as TOOL

ROW = {"name": "lego", "size": "200x200", "preset": "tiny", "steps": 300, "views": 200}
ROW |= {"minutes": 0.5, "psnr": 28.1234, "ssim": 0.95, "lpips": 0.05, "points": 90000}
ROW |= {"frame_ms": 14.0, "computed": 1.0}
RASTER = {
    "scene": "grid",
    "points": 250336,
    "size": 200,
    "blend": "alpha",
    "forward_ms": 13.7,
    "backward_ms": 2.1,
}
RASTER |= {"ms": 15.8, "max_err": 8e-8}
TORCH = {"widths": "32,64,128", "size": 200, "variant": "auto", "rel_l2": 4e-7}
TORCH |= {"torch_rel_l2": 4e-7}
for key in ("forward", "train"):
    TORCH |= {f"{key}_ours_ms": 13.1, f"{key}_torch_ms": 18.6, f"{key}_ratio": 1.4}
STEP = {"points": 92812, "size": "128x128", "stages": [{"stage": "shade", "ms": 6.2}]}
MEMORY = {"name": "tiny", "points": 253464, "device_plan": 7e2, "device": 7e2}
MEMORY |= {"host_plan": 1e3, "host": 1e3}
FOUND = dict.fromkeys(TOOL.PARTS, ROW)
FOUND |= {"demo": [{"what": "mesh", "result": "0.76"}]}
FOUND |= {"rasteriser": [RASTER], "memory": [MEMORY]}
FOUND |= {"pytorch": [TORCH], "stages": dict.fromkeys(TOOL.STEPS, STEP)}


def test_tables_and_plots(tmp_path):
    about = dict.fromkeys(("commit", "date", "machine", "decides"), "1")
    for contents in TOOL.tables(FOUND).values():
        written = docs_tables.table(about | contents)
        last = written.splitlines()[-1].split("|")[1:-1]
        assert len(last) == len(contents["columns"]) and all(cell.strip() for cell in last)
    TOOL.draw(TOOL.trained(FOUND), TOOL.timed(FOUND), tmp_path)
    assert len({*tmp_path.glob("*.png")}) == 4
