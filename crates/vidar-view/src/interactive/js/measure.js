// The distance of two points, with what the uncertainty of the scale makes of it.

function lengthText(value) { return value.toFixed(3); }

// A length in a pane, in words.
function measured(pane, value) {
  if (!pane.isMetric) {
    return lengthText(value) + " units: not metric, the scale of this run is arbitrary";
  }
  if (pane.isReference) return lengthText(value) + " m in the reference";
  if (pane.scaleLogStd === null) {
    return lengthText(value) + " m; the uncertainty of the scale is not known";
  }
  const percent = (100 * pane.scaleLogStd).toFixed(1);
  return lengthText(value) + " m ± " + lengthText(value * pane.scaleLogStd) +
    " m (1 σ of the scale, " + percent + " %)";
}

// The same, short enough for the picture.
function measuredShort(pane, value) {
  if (!pane.isMetric) return lengthText(value) + " units, not metric";
  if (pane.isReference || pane.scaleLogStd === null) return lengthText(value) + " m";
  return lengthText(value) + " m ± " + lengthText(value * pane.scaleLogStd) + " m";
}

// Points of one pane: none, one or two. A third starts anew, and so does a point in another pane.
function Measurement() {
  this.isOn = false;
  this.clear();
}

Measurement.prototype.clear = function () {
  this.pane = null;
  this.points = [];
};

Measurement.prototype.take = function (pane, point) {
  if (pane !== this.pane || this.points.length >= 2) this.clear();
  this.pane = pane;
  this.points.push(point);
};

Measurement.prototype.value = function () {
  return this.points.length === 2 ? distance(this.points[0], this.points[1]) : null;
};

Measurement.prototype.text = function () {
  if (this.points.length === 2) return "Distance: " + measured(this.pane, this.value()) + ".";
  if (this.points.length === 1) return "First point taken. Click the second point, or aim the cross and press Enter.";
  return "Click the first point, or aim the cross and press Enter.";
};
