"""What a page draws, in Chromium without a window."""

import base64
import io
import json
import re
import subprocess

import numpy as np
from PIL import Image
from support.chromium import find_chromium

# WebGL on the CPU, so that no graphics card is needed
OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--virtual-time-budget=20000",
    "--dump-dom",
)
# `found` of a script becomes the page's whole content
PROBE = """<script>
const pre = document.createElement("pre");
try { pre.textContent = "found" + JSON.stringify((() => { %s })()) + "end"; }
catch (error) { pre.textContent = `error ${error}`; }
document.body.replaceChildren(pre);
document.querySelectorAll("script").forEach((script) => script.remove());
</script>"""


def ask(page, script, tmp_path, fragment=""):
    """What a script returns that runs in a page after it has loaded, as JSON says it.

    page: the file. script: the body of a function. fragment: of the page's address, from # on.
    """
    probe = tmp_path / "probe.html"
    probe.write_text(page.read_text("utf-8") + PROBE % script, "utf-8")
    words = [find_chromium(), *OPTIONS, f"--user-data-dir={tmp_path / 'profile'}"]
    done = subprocess.run(
        [*words, f"{probe.as_uri()}{fragment}"], capture_output=True, text=True, timeout=120
    )
    found = re.search(r"<pre>found(.*)end</pre>", done.stdout, re.DOTALL)
    assert found, done.stdout[-500:] + done.stderr[-500:]
    return json.loads(found[1].replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">"))


def image_of(url):
    """(H, W, 3) uint8 image of a data URL of a PNG."""
    data = base64.b64decode(url.partition("base64,")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
