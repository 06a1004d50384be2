"""What an exported page draws, in Chromium without a window."""

import asyncio
import base64
import io

import numpy as np
from PIL import Image
from support.chromium import chromium

# WebGL on the CPU, so that no graphics card is needed
WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def ask(file, script, fragment=""):
    """What a script returns that runs in a page after it has loaded.

    file: the page. script: the body of a function. fragment: of the page's address, from # on.
    """

    async def scenario():
        async with chromium(*WEBGL) as browser, browser.page() as page:
            await page.open(f"{file.as_uri()}{fragment}")
            return await page.evaluate(f"(() => {{ {script} }})()")

    return asyncio.run(scenario())


def image_of(url):
    """(H, W, 3) uint8 image of a data URL of a PNG."""
    data = base64.b64decode(url.partition("base64,")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
