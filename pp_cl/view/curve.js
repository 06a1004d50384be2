// The curve of PSNR (linear) and loss (logarithmic) over the steps, each on its own scale.

const PSNR = "#7fb4ff", LOSS = "#ffb86b", LINE = "#34373d", QUIET = "#a0a4ab";
const MARGIN = { left: 4, right: 4, top: 6, bottom: 16 };

export function drawCurve(canvas, rows) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width || !rows.length) return;
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const g = canvas.getContext("2d");
  g.scale(ratio, ratio);
  const inner = { w: width - MARGIN.left - MARGIN.right, h: height - MARGIN.top - MARGIN.bottom };
  g.strokeStyle = LINE;
  for (let i = 0; i <= 3; i++) {
    const y = Math.round(MARGIN.top + (inner.h * i) / 3) + 0.5;
    g.beginPath(); g.moveTo(MARGIN.left, y); g.lineTo(width - MARGIN.right, y); g.stroke();
  }
  const last = rows[rows.length - 1][0], first = rows[0][0];
  const x = (step) => MARGIN.left + (inner.w * (step - first)) / Math.max(1, last - first);
  line(g, rows.map((r) => [x(r[0]), Math.log(Math.max(r[1], 1e-9))]), inner.h, LOSS);
  line(g, rows.map((r) => [x(r[0]), r[2]]), inner.h, PSNR);
  g.fillStyle = QUIET;
  g.font = "11px system-ui, sans-serif";
  g.fillText(`${first}`, MARGIN.left, height - 3);
  g.textAlign = "right";
  g.fillText(`step ${last}`, width - MARGIN.right, height - 3);
}

function line(g, points, height, colour) {
  const values = points.map((p) => p[1]);
  const low = Math.min(...values), span = Math.max(...values) - low || 1;
  g.strokeStyle = colour;
  g.lineWidth = 1.5;
  g.lineJoin = "round";
  g.beginPath();
  points.forEach(([x, value], i) => {
    const y = MARGIN.top + height * (1 - (value - low) / span);
    if (i) g.lineTo(x, y); else g.moveTo(x, y);
  });
  g.stroke();
}
