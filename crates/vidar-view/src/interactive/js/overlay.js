// What is written over the picture: scale bar, axes, colour scale, names, measurement.

const FONT = "12px system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', 'DejaVu Sans', sans-serif";

// 1, 2 or 5 times a power of ten, at most `value`.
function roundLength(value) {
  const power = Math.pow(10, Math.floor(Math.log10(value)));
  return [5, 2, 1].map(function (f) { return f * power; }).find(function (v) { return v <= value * 1.000001; });
}

function shortLength(value, isMetric) {
  if (!isMetric) return String(Number(value.toPrecision(3))) + " units";
  return value < 1 ? Math.round(value * 1000) / 10 + " cm" : Number(value.toPrecision(3)) + " m";
}

// Text on a veil of the background, so that it can be read on any surface.
function label(c, view, text, x, y, align) {
  c.font = FONT;
  c.textAlign = align;
  c.textBaseline = "middle";
  const width = c.measureText(text).width;
  const left = align === "center" ? x - width / 2 : align === "right" ? x - width : x;
  c.globalAlpha = 0.82;
  c.fillStyle = view.colors.paper;
  c.fillRect(left - 4, y - 9, width + 8, 18);
  c.globalAlpha = 1;
  c.fillStyle = view.colors.ink;
  c.fillText(text, x, y);
}

// A length on the screen, at the distance of what is in the middle of the picture.
function drawScaleBar(c, view, pane, rect, lens) {
  const depth = view.depthInMiddle(pane, lens);
  const pixel = pixelLength(lens, depth);
  const length = roundLength(pixel * rect.width * 0.25);
  const pixels = length / pixel;
  const x = rect.x + 16;
  const y = rect.y + rect.height - 18;
  c.globalAlpha = 0.82;
  c.fillStyle = view.colors.paper;
  c.fillRect(x - 8, y - 24, Math.max(pixels, 60) + 16, 34);
  c.globalAlpha = 1;
  c.strokeStyle = view.colors.ink;
  c.lineWidth = 2;
  c.beginPath();
  c.moveTo(x, y - 5);
  c.lineTo(x, y);
  c.lineTo(x + pixels, y);
  c.lineTo(x + pixels, y - 5);
  c.stroke();
  c.fillStyle = view.colors.ink;
  c.font = FONT;
  c.textAlign = "left";
  c.textBaseline = "middle";
  // In perspective a bar has its length at one distance only.
  const where = lens.isParallel ? "" : " in the middle";
  c.fillText(shortLength(length, pane.isMetric) + (pixels > 130 ? where : ""), x, y - 14);
  pane.scaleBar = { length: length, pixels: pixels, depth: depth };
}

function drawAxes(c, view, rect, lens) {
  const size = 26;
  const x = rect.x + 42;
  const y = rect.y + 46;
  const axes = [["x", [1, 0, 0], "#d1242f"], ["y", [0, 1, 0], "#1a7f37"], ["z", [0, 0, 1], "#0969da"]];
  const drawn = axes.map(function (a) {
    const f = lens.frame;
    return { name: a[0], color: a[2], dx: dot(a[1], f.right), dy: -dot(a[1], f.up), dz: -dot(a[1], f.forward) };
  });
  // Those that point away are drawn first.
  drawn.sort(function (a, b) { return a.dz - b.dz; });
  drawn.forEach(function (a) {
    c.strokeStyle = a.color;
    c.fillStyle = a.color;
    c.lineWidth = 2.5;
    c.beginPath();
    c.moveTo(x, y);
    c.lineTo(x + size * a.dx, y + size * a.dy);
    c.stroke();
    c.font = "bold " + FONT;
    c.textAlign = "center";
    c.textBaseline = "middle";
    c.fillText(a.name, x + (size + 9) * a.dx, y + (size + 9) * a.dy);
  });
}

// Name, range in numbers and table of the colours that are shown.
function legendOf(view, pane) {
  if (view.coloring === "color") return null;
  if (view.coloring === "height") {
    return { label: pane.isMetric ? "height [m]" : "height [units]", range: view.heights, table: view.maps.sea };
  }
  const field = pane.fields.find(function (f) { return f.id === view.coloring; });
  if (!field || !field.range) return { label: field ? "not available: " + field.reason : "no such values here", range: null };
  return { label: field.label, range: field.range, table: view.maps[field.map] };
}

function drawLegend(c, view, pane, rect) {
  const legend = legendOf(view, pane);
  if (!legend) return;
  const right = rect.x + rect.width - 14;
  const bottom = rect.y + rect.height - 12;
  if (!legend.range) return label(c, view, legend.label, right, bottom - 8, "right");
  const width = Math.min(200, rect.width * 0.45);
  const left = right - width;
  c.font = FONT;
  const veil = Math.max(width, Math.min(c.measureText(legend.label).width, rect.width - 40));
  c.globalAlpha = 0.82;
  c.fillStyle = view.colors.paper;
  c.fillRect(right - veil - 8, bottom - 48, veil + 16, 54);
  c.globalAlpha = 1;
  for (let i = 0; i < width; i++) {
    const from = 3 * Math.round(254 * i / (width - 1));
    c.fillStyle = "rgb(" + legend.table[from] + "," + legend.table[from + 1] + "," + legend.table[from + 2] + ")";
    c.fillRect(left + i, bottom - 28, 1.5, 12);
  }
  c.fillStyle = view.colors.ink;
  c.textBaseline = "middle";
  c.textAlign = "right";
  c.fillText(legend.label, right, bottom - 38);
  const span = legend.range[1] - legend.range[0];
  const digits = span >= 10 ? 1 : span >= 0.5 ? 2 : 3;
  [0, 0.5, 1].forEach(function (share) {
    c.textAlign = ["left", "center", "right"][2 * share];
    c.fillText((legend.range[0] + share * span).toFixed(digits), left + share * width, bottom - 6);
  });
}

function drawMeasurement(c, view, pane, rect, lens) {
  const m = view.measurement;
  if (m.isOn && view.cursor.isKeyboard) {
    const x = rect.x + rect.width / 2;
    const y = rect.y + rect.height / 2;
    c.strokeStyle = view.colors.ink;
    c.lineWidth = 1.5;
    c.beginPath();
    [[-12, 0, -4, 0], [4, 0, 12, 0], [0, -12, 0, -4], [0, 4, 0, 12]].forEach(function (s) {
      c.moveTo(x + s[0], y + s[1]);
      c.lineTo(x + s[2], y + s[3]);
    });
    c.stroke();
  }
  if (m.pane !== pane) return;
  const at = m.points.map(function (p) { return pixelOf(lens, p); });
  if (at.indexOf(null) >= 0) return;
  const line = function (color, width) {
    c.strokeStyle = color;
    c.lineWidth = width;
    c.beginPath();
    at.forEach(function (p, i) { if (i) c.lineTo(rect.x + p.x, rect.y + p.y); else c.moveTo(rect.x + p.x, rect.y + p.y); });
    c.stroke();
  };
  line("#ffffff", 5);
  line("#c9148a", 2.5);
  at.forEach(function (p) {
    c.beginPath();
    c.arc(rect.x + p.x, rect.y + p.y, 5, 0, 2 * Math.PI);
    c.fillStyle = "#c9148a";
    c.fill();
    c.strokeStyle = "#ffffff";
    c.lineWidth = 2;
    c.stroke();
  });
  if (at.length === 2) {
    const text = measuredShort(pane, m.value());
    c.font = FONT;
    const half = c.measureText(text).width / 2 + 8;
    const x = clamped((at[0].x + at[1].x) / 2, half, rect.width - half);
    const y = clamped((at[0].y + at[1].y) / 2 - 18, 14, rect.height - 14);
    label(c, view, text, rect.x + x, rect.y + y, "center");
  }
}

function drawOverlay(c, view, pane, rect, lens) {
  c.save();
  c.beginPath();
  c.rect(rect.x, rect.y, rect.width, rect.height);
  c.clip();
  drawAxes(c, view, rect, lens);
  drawScaleBar(c, view, pane, rect, lens);
  drawLegend(c, view, pane, rect);
  drawMeasurement(c, view, pane, rect, lens);
  if (view.shownPanes().length > 1) {
    label(c, view, pane.name, rect.x + rect.width / 2, rect.y + 16, "center");
    c.strokeStyle = view.colors.line;
    c.lineWidth = 1;
    c.strokeRect(rect.x + 0.5, rect.y + 0.5, rect.width - 1, rect.height - 1);
  }
  c.restore();
}
