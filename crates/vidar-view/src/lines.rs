//! The general x-y plot: errors over time, timings, curves of precision and recall.

use crate::Picture;
use crate::axes::{AxisFace, Frame, Margins, Swatch, axis_title, draw_empty_note, draw_header};
use crate::canvas::{Area, Canvas, Pen, Rgb, clip_segment, theme};
use crate::size::{PictureSize, TypeScale};
use crate::text::{Align, TextStyle};
use crate::ticks::{LARGEST, Ticks, padded, range_of};

/// One axis of a plot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AxisSpec {
    /// What it shows (`position error`).
    pub label: String,
    /// Its unit (`m`); empty for pure numbers.
    pub unit: String,
    /// Fixed ends, low and high; `None` fits the data.
    pub range: Option<(f64, f64)>,
    /// Whether zero is shown even where no value is near it.
    pub includes_zero: bool,
}

impl AxisSpec {
    /// An axis that fits its data.
    pub fn new(label: impl Into<String>, unit: impl Into<String>) -> Self {
        Self { label: label.into(), unit: unit.into(), ..Self::default() }
    }

    /// The same axis with zero included: for errors, durations, counts.
    pub fn from_zero(self) -> Self {
        Self { includes_zero: true, ..self }
    }

    /// The same axis with fixed ends.
    pub fn between(self, low: f64, high: f64) -> Self {
        Self { range: Some((low, high)), ..self }
    }
}

/// How a series is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Mark {
    /// A line through the points; a value that is not finite breaks it.
    #[default]
    Line,
    /// A dot at every point.
    Points,
}

/// Points of one kind.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub label: String,
    /// x and y.
    pub points: Vec<[f64; 2]>,
    /// How it is drawn.
    pub mark: Mark,
}

impl Series {
    /// A line.
    pub fn line(label: impl Into<String>, points: Vec<[f64; 2]>) -> Self {
        Self { label: label.into(), points, mark: Mark::Line }
    }

    /// Dots.
    pub fn dots(label: impl Into<String>, points: Vec<[f64; 2]>) -> Self {
        Self { label: label.into(), points, mark: Mark::Points }
    }
}

/// A horizontal reference level: a threshold, a median.
#[derive(Clone, Debug, PartialEq)]
pub struct ReferenceLine {
    /// Where, on the y axis.
    pub value: f64,
    /// What it is (`RMSE 0.043 m`).
    pub label: String,
}

/// An x-y plot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LinePlot {
    /// Title; may be empty.
    pub title: String,
    /// Horizontal axis.
    pub x: AxisSpec,
    /// Vertical axis.
    pub y: AxisSpec,
    /// The series, in the order of the legend; later ones are drawn on top.
    pub series: Vec<Series>,
    /// Horizontal levels.
    pub references: Vec<ReferenceLine>,
}

/// Draws an x-y plot with axes, grid, legend and reference levels.
pub fn plot_lines(plot: &LinePlot, size: PictureSize) -> Picture {
    let scale = size.type_scale();
    let mut canvas = Canvas::new(size, theme::PAPER);
    let outer = draw_header(&mut canvas, size, &plot.title, &legend(plot, scale));
    let points = || plot.series.iter().flat_map(|s| &s.points).filter(|p| is_drawable(p));
    let levels = plot.references.iter().map(|r| r.value);
    let x_data = range_of(points().map(|p| p[0]));
    let y_data = range_of(points().map(|p| p[1]).chain(levels));
    let (x, y, area) = fitted_axes(plot, x_data, y_data, &outer, scale);
    let frame = Frame { area, x: x.range, y: y.range };
    frame.draw(&mut canvas, &x, &y, scale);
    if points().next().is_none() {
        draw_empty_note(&mut canvas, &area, "no data", scale);
    }
    for (i, series) in plot.series.iter().enumerate() {
        draw_series(&mut canvas, &frame, series, series_color(i), scale);
    }
    for reference in &plot.references {
        draw_reference(&mut canvas, &frame, reference, scale);
    }
    canvas.into_picture()
}

fn is_drawable(p: &[f64; 2]) -> bool {
    p.iter().all(|v| v.abs() <= LARGEST)
}

pub(crate) fn series_color(i: usize) -> Rgb {
    theme::DATA[i % theme::DATA.len()]
}

fn legend(plot: &LinePlot, scale: TypeScale) -> Vec<(String, Swatch)> {
    let named = plot.series.iter().enumerate().filter(|(_, s)| !s.label.is_empty());
    named
        .map(|(i, s)| match s.mark {
            Mark::Line => (s.label.clone(), Swatch::Line(Pen::new(series_color(i), 2.0 * scale.unit))),
            Mark::Points => (s.label.clone(), Swatch::Dot(series_color(i))),
        })
        .collect()
}

fn fitted_axes(
    plot: &LinePlot,
    x_data: Option<(f64, f64)>,
    y_data: Option<(f64, f64)>,
    outer: &Area,
    scale: TypeScale,
) -> (AxisFace, AxisFace, Area) {
    let x_range = axis_range(&plot.x, x_data, 0.0);
    let y_range = axis_range(&plot.y, y_data, 0.05);
    // Margins depend on the labels, and the number of labels on the margins: two passes.
    let faces = |columns: usize, rows: usize| {
        let x_ticks = Ticks::between(x_range.0, x_range.1, columns);
        let y_ticks = Ticks::between(y_range.0, y_range.1, rows);
        let x = AxisFace::new(axis_title(&plot.x.label, &plot.x.unit), x_range, &x_ticks);
        let y = AxisFace::new(axis_title(&plot.y.label, &plot.y.unit), y_range, &y_ticks);
        let area = Margins::around(&x, &y, scale).inside(outer);
        (x, y, area)
    };
    let (x, _, area) = faces(6, 6);
    faces(intervals_that_fit(area.width, &x.marks, scale), rows_that_fit(area.height, scale))
}

/// How many tick intervals fit above each other.
pub(crate) fn rows_that_fit(height: f64, scale: TypeScale) -> usize {
    (height / (3.0 * scale.line())).clamp(1.0, 10.0) as usize
}

/// How many tick intervals fit next to each other without their labels touching.
pub(crate) fn intervals_that_fit(width: f64, marks: &[(f64, String)], scale: TypeScale) -> usize {
    let ink = TextStyle::new(scale.body, theme::INK);
    let widest = marks.iter().map(|(_, l)| ink.width_of(l)).fold(ink.width_of("0.0"), f64::max);
    (width / (widest + 2.0 * scale.line())).clamp(1.0, 10.0) as usize
}

pub(crate) fn axis_range(axis: &AxisSpec, data: Option<(f64, f64)>, pad: f64) -> (f64, f64) {
    if let Some((low, high)) = axis.range.filter(|(l, h)| l.abs() <= LARGEST && h.abs() <= LARGEST && l < h) {
        return (low, high);
    }
    let Some((low, high)) = data else { return (0.0, 1.0) };
    if !axis.includes_zero {
        return padded((low, high), pad);
    }
    let (low, high) = (low.min(0.0), high.max(0.0));
    let (padded_low, padded_high) = padded((low, high), pad);
    // An end at zero stays at zero.
    (if low == 0.0 { 0.0 } else { padded_low }, if high == 0.0 && low < 0.0 { 0.0 } else { padded_high })
}

fn draw_series(canvas: &mut Canvas, frame: &Frame, series: &Series, color: Rgb, scale: TypeScale) {
    match series.mark {
        Mark::Line => {
            let pen = Pen::new(color, 2.0 * scale.unit);
            for run in series.points.split(|p| !is_drawable(p)) {
                let pixels: Vec<_> = run.iter().map(|p| frame.at(p[0], p[1])).collect();
                draw_clipped(canvas, &frame.area, &thinned(&pixels), pen);
            }
        }
        Mark::Points => {
            let mut last = (f64::NAN, f64::NAN);
            for p in series.points.iter().filter(|p| is_drawable(p)) {
                let (x, y) = frame.at(p[0], p[1]);
                let inside = x >= frame.area.left - 0.5
                    && x <= frame.area.right() + 0.5
                    && y >= frame.area.top - 0.5
                    && y <= frame.area.bottom() + 0.5;
                // A dot at the same pixel as the one before is skipped, for speed.
                if inside && !((x - last.0).abs() < 0.25 && (y - last.1).abs() < 0.25) {
                    canvas.disc((x, y), 2.4 * scale.unit, color);
                    last = (x, y);
                }
            }
        }
    }
}

/// A line drawn only where it lies within `area`.
pub(crate) fn draw_clipped(canvas: &mut Canvas, area: &Area, points: &[(f64, f64)], pen: Pen) {
    if let [only] = points {
        if clip_segment(area, *only, *only).is_some() {
            canvas.disc(*only, 0.9 * pen.width, pen.color);
        }
        return;
    }
    let mut run: Vec<(f64, f64)> = Vec::new();
    for pair in points.windows(2) {
        let Some([a, b]) = clip_segment(area, pair[0], pair[1]) else {
            canvas.polyline(&run, pen);
            run.clear();
            continue;
        };
        if run.last() != Some(&a) {
            canvas.polyline(&run, pen);
            run.clear();
            run.push(a);
        }
        run.push(b);
    }
    canvas.polyline(&run, pen);
}

/// Reduces points without visible change: of consecutive points within one pixel column the first, lowest, highest and
/// last are kept, so that no spike is lost.
pub(crate) fn thinned(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut kept = Vec::new();
    for column in points.chunk_by(|a, b| a.0.floor() == b.0.floor()) {
        if column.len() <= 4 {
            kept.extend_from_slice(column);
            continue;
        }
        let by_height = |a: &usize, b: &usize| column[*a].1.total_cmp(&column[*b].1);
        let lowest = (0..column.len()).min_by(by_height).unwrap_or(0);
        let highest = (0..column.len()).max_by(by_height).unwrap_or(0);
        let mut indices = [0, lowest, highest, column.len() - 1];
        indices.sort_unstable();
        for (k, &i) in indices.iter().enumerate() {
            if k == 0 || indices[k - 1] != i {
                kept.push(column[i]);
            }
        }
    }
    kept
}

fn draw_reference(canvas: &mut Canvas, frame: &Frame, reference: &ReferenceLine, scale: TypeScale) {
    let y = frame.py(reference.value);
    if !(y >= frame.area.top && y <= frame.area.bottom()) {
        return;
    }
    let pen = Pen::new(theme::QUIET_INK, 1.5 * scale.unit).dashed(7.0 * scale.unit, 5.0 * scale.unit);
    canvas.rule([(frame.area.left, y), (frame.area.right(), y)], pen);
    let style = TextStyle::new(scale.body, theme::INK);
    let text = style.fitted(&reference.label, frame.area.width - scale.line());
    let width = style.width_of(&text);
    let right = frame.area.right() - 0.5 * scale.line();
    // Above the line unless the frame ends there.
    let up = if y - 1.4 * scale.line() > frame.area.top { -0.7 } else { 0.7 };
    let middle = y + up * scale.line();
    let halo = Area {
        left: right - width - 3.0,
        top: middle - 0.5 * scale.line(),
        width: width + 6.0,
        height: scale.line(),
    };
    canvas.veil(&halo, theme::PAPER, 200);
    canvas.text((right, middle), &text, Align::End, &style);
}

#[cfg(test)]
mod tests;
