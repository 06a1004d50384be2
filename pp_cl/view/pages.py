"""The web application behind a page: its files and what it asks for, for those alone who have the
access.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from importlib.resources import files

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from pp_cl.view.access import Access

GRACE_SECONDS = 1.0  # for requests in work when the server ends
SHARED = {
    "page.css": "text/css",
    "camera.js": "text/javascript",
    "frustums.js": "text/javascript",
    "icon.svg": "image/svg+xml",
}


def application(
    access: Access, page: str, scripts: Sequence[str], routes: Sequence[web.RouteDef], most: int
) -> web.Application:
    """The application of one page. page: its HTML file; scripts: its own; routes: below the token,
    what else it asks for; most: bytes of a request's body.
    """
    kinds = {page: "text/html", **SHARED, **dict.fromkeys(scripts, "text/javascript")}
    served = {
        "" if file == page else file: (files("pp_cl.view").joinpath(file).read_bytes(), kind)
        for file, kind in kinds.items()
    }

    @web.middleware
    async def guard(request, handler):
        if refusal := access.refusal(request.path):
            raise web.HTTPForbidden(text=f"403: {refusal}\n")
        return await handler(request)

    async def set_headers(request, response):
        response.headers.update(access.headers(request.headers.get("Host", "")))

    async def file(request):
        if request.match_info["name"] not in served:
            raise web.HTTPNotFound
        body, kind = served[request.match_info["name"]]
        return web.Response(body=body, content_type=kind, charset="utf-8")

    app = web.Application(middlewares=[guard], client_max_size=most)
    app.on_response_prepare.append(set_headers)
    app.router.add_routes(routes)
    app.router.add_get("/{token}/{name:[^/]*}", file)
    return app


def runner(app: web.Application) -> web.AppRunner:
    """Runs an application; its log has bugs alone."""
    logger = logging.getLogger(__name__)
    logger.addFilter(_is_a_bug)
    return web.AppRunner(app, access_log=None, logger=logger, shutdown_timeout=GRACE_SECONDS)


def _is_a_bug(record):
    """Whether a record of the log is worth its traceback: broken HTTP of a stranger is not."""
    return not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError))
