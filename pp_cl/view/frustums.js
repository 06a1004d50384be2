// The frustums of the training views, drawn over the picture.
import { fromFacts, project, unproject } from "./camera.js";

const NEAR_CLICK = 22; // pixels from the middle of a frustum

// [[column, row] of the eye on the overlay, lines of the frustum] for each view ahead of the camera
export function frustums(around, at, perPixel) {
  const size = 0.12 * around.radius;
  return around.views.map((view) => {
    const c = fromFacts(view.camera), depth = (size * 2 * c.fx) / Math.max(c.w, c.h) / 2;
    const corners = [[0, 0], [c.w, 0], [c.w, c.h], [0, c.h]].map(([u, v]) => unproject(c, u, v, depth));
    const points = [c.eye, ...corners].map((p) => project(at, p));
    if (points.some((p) => p[2] < 0.02 * around.radius)) return null;
    return points.map(([u, v]) => [u * perPixel, v * perPixel]);
  });
}

export function drawFrustums(g, found, hovered, colour = "#3d7fd8a0") {
  found.forEach((points, i) => {
    if (!points) return;
    const [eye, ...corners] = points;
    g.strokeStyle = i === hovered ? "#ff8a1f" : colour;
    g.lineWidth = i === hovered ? 2 : 1;
    g.beginPath();
    corners.forEach((corner, k) => {
      g.moveTo(...eye); g.lineTo(...corner); g.lineTo(...corners[(k + 1) % 4]);
    });
    g.stroke();
  });
}

// The frustum whose middle is nearest to a place on the overlay, or null.
export function frustumAt(found, x, y) {
  let best = null, least = NEAR_CLICK;
  found.forEach((points, i) => {
    if (!points) return;
    const middle = [0, 1].map((k) => points.reduce((sum, p) => sum + p[k], 0) / points.length);
    const away = Math.hypot(x - middle[0], y - middle[1]);
    if (away < least) [best, least] = [i, away];
  });
  return best;
}
