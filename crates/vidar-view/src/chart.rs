//! Distributions and comparisons: histograms and bars.

use crate::Picture;
use crate::axes::{AxisFace, Frame, Margins, Swatch, axis_title, draw_empty_note, draw_header};
use crate::canvas::{Area, Canvas, Pen, theme};
use crate::lines::{AxisSpec, axis_range, intervals_that_fit, rows_that_fit, series_color};
use crate::size::{PictureSize, TypeScale};
use crate::text::{Align, TextStyle};
use crate::ticks::{LARGEST, Ticks, nice_step, padded, range_of, short_number};

/// A histogram of one quantity.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Histogram {
    /// Title; may be empty.
    pub title: String,
    /// The quantity. With a fixed range, values outside it are counted in a note.
    pub x: AxisSpec,
    /// The values; those that are not finite are counted in a note.
    pub values: Vec<f64>,
    /// Marked values, with names (`median 0.012 m`).
    pub markers: Vec<(f64, String)>,
}

/// Bars of one kind over all categories.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BarGroup {
    /// Name in the legend; may be empty when there is one group only.
    pub label: String,
    /// One value per category; missing or not finite ones have no bar.
    pub values: Vec<f64>,
}

/// Horizontal bars, one row per category.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BarPlot {
    /// Title; may be empty.
    pub title: String,
    /// The quantity; its axis always includes zero.
    pub value: AxisSpec,
    /// Names of the categories, top to bottom.
    pub categories: Vec<String>,
    /// What is compared within each category.
    pub groups: Vec<BarGroup>,
}

/// Draws a histogram with bins of a width of 1, 2 or 5 times a power of ten (Freedman and Diaconis 1981, rounded).
pub fn plot_histogram(histogram: &Histogram, size: PictureSize) -> Picture {
    let scale = size.type_scale();
    let bins = Bins::of(histogram);
    let mut canvas = Canvas::new(size, theme::PAPER);
    let mut outer = draw_header(&mut canvas, size, &histogram.title, &[]);
    outer = draw_note(&mut canvas, outer, &bins.note(histogram), scale);

    let most = bins.counts.iter().copied().max().unwrap_or(0);
    let y_range = (0.0, (most as f64 * 1.08).max(1.0));
    let faces = |columns: usize, rows: usize| {
        let x = AxisFace::new(
            axis_title(&histogram.x.label, &histogram.x.unit),
            bins.range,
            &Ticks::between(bins.range.0, bins.range.1, columns),
        );
        // Counts are whole: no ticks between them.
        let step = nice_step(y_range.1, rows).max(1.0);
        let y = AxisFace::new("count".to_owned(), y_range, &Ticks::with_step(0.0, y_range.1, step));
        let area = Margins::around(&x, &y, scale).inside(&outer);
        (x, y, area)
    };
    let (x, _, area) = faces(6, 6);
    let (x, y, area) =
        faces(intervals_that_fit(area.width, &x.marks, scale), rows_that_fit(area.height, scale));
    let frame = Frame { area, x: x.range, y: y.range };
    frame.draw(&mut canvas, &x, &y, scale);
    if most == 0 {
        draw_empty_note(&mut canvas, &area, "no data", scale);
    }
    bins.draw(&mut canvas, &frame);
    draw_markers(&mut canvas, &frame, &histogram.markers, scale);
    canvas.into_picture()
}

struct Bins {
    range: (f64, f64),
    first: f64,
    width: f64,
    counts: Vec<usize>,
    below: usize,
    above: usize,
    not_finite: usize,
}

impl Bins {
    fn of(histogram: &Histogram) -> Self {
        let mut values: Vec<f64> = histogram.values.iter().copied().filter(|v| v.abs() <= LARGEST).collect();
        let not_finite = histogram.values.len() - values.len();
        values.sort_unstable_by(f64::total_cmp);
        let (low, high) = axis_range(&histogram.x, range_of(values.iter().copied()), 0.0);
        let width = bin_width(&values, high - low);
        let first = (low / width + 1e-9).floor() * width;
        let count = (((high - first) / width - 1e-9).ceil()).clamp(1.0, 200.0) as usize;
        let mut bins = Self {
            range: (first, first + count as f64 * width),
            first,
            width,
            counts: vec![0; count],
            below: 0,
            above: 0,
            not_finite,
        };
        for v in values {
            let place = (v - first) / width;
            if place < -1e-9 {
                bins.below += 1;
            } else if place > count as f64 + 1e-9 {
                bins.above += 1;
            } else {
                bins.counts[(place.max(0.0) as usize).min(count - 1)] += 1;
            }
        }
        bins
    }

    fn note(&self, histogram: &Histogram) -> String {
        let unit = &histogram.x.unit;
        let ends = [short_number(self.range.0), short_number(self.range.1)];
        let shown: usize = self.counts.iter().sum();
        let mut parts = vec![format!("n = {shown}")];
        if self.below > 0 {
            parts.push(format!("{} below {} {unit}", self.below, ends[0]));
        }
        if self.above > 0 {
            parts.push(format!("{} above {} {unit}", self.above, ends[1]));
        }
        if self.not_finite > 0 {
            parts.push(format!("{} without a value", self.not_finite));
        }
        parts.join(", ")
    }

    fn draw(&self, canvas: &mut Canvas, frame: &Frame) {
        for (i, &count) in self.counts.iter().enumerate().filter(|(_, c)| **c > 0) {
            let left = frame.px(self.first + i as f64 * self.width).round();
            let right = frame.px(self.first + (i + 1) as f64 * self.width).round();
            let top = frame.py(count as f64).min(frame.area.bottom() - 1.0);
            // A pixel of paper between neighbours where there is room for it.
            let width = if right - left > 3.0 { right - left - 1.0 } else { right - left };
            let area = Area { left, top, width, height: frame.area.bottom() - top };
            canvas.fill_area(&area, theme::DATA[0]);
        }
    }
}

/// Between 12 and 60 bins over `span`, by the rule of Freedman and Diaconis, clamped.
fn bin_width(sorted: &[f64], span: f64) -> f64 {
    let quantile = |q: f64| sorted.get((q * (sorted.len().saturating_sub(1)) as f64) as usize).copied();
    let spread = quantile(0.75).zip(quantile(0.25)).map_or(0.0, |(a, b)| a - b);
    let wanted = 2.0 * spread / (sorted.len().max(1) as f64).cbrt();
    let width = wanted.clamp(span / 60.0, span / 12.0);
    nice_step(width, 1)
}

fn draw_note(canvas: &mut Canvas, outer: Area, note: &str, scale: TypeScale) -> Area {
    let (line, side) = (scale.line(), 0.8 * scale.line());
    let style = TextStyle::new(scale.body, theme::QUIET_INK);
    let text = style.fitted(note, canvas.width() - 2.0 * side);
    canvas.text((side, outer.top + 0.6 * line), &text, Align::Start, &style);
    Area { top: outer.top + 1.3 * line, height: (outer.height - 1.3 * line).max(8.0), ..outer }
}

/// Vertical lines with their names stacked, so that close ones stay readable.
fn draw_markers(canvas: &mut Canvas, frame: &Frame, markers: &[(f64, String)], scale: TypeScale) {
    let style = TextStyle::new(scale.body, theme::INK);
    let (line, area) = (scale.line(), frame.area);
    for (row, (value, label)) in markers.iter().enumerate() {
        let x = frame.px(*value);
        if !(x >= area.left && x <= area.right()) {
            continue;
        }
        let pen = Pen::new(theme::DATA[1], 2.0 * scale.unit).dashed(7.0 * scale.unit, 4.0 * scale.unit);
        canvas.rule([(x, area.top), (x, area.bottom())], pen);
        let text = style.fitted(label, 0.6 * area.width);
        let width = style.width_of(&text);
        let fits_right = x + 0.5 * line + width < area.right();
        let left = if fits_right { x + 0.5 * line } else { x - 0.5 * line - width };
        let y = area.top + (0.9 + 1.3 * row as f64) * line;
        if y + line > area.bottom() {
            break;
        }
        let halo = Area { left: left - 3.0, top: y - 0.5 * line, width: width + 6.0, height: line };
        canvas.veil(&halo, theme::PAPER, 215);
        canvas.text((left, y), &text, Align::Start, &style);
    }
}

/// Draws horizontal bars with their values at the ends.
pub fn plot_bars(plot: &BarPlot, size: PictureSize) -> Picture {
    let scale = size.type_scale();
    let mut canvas = Canvas::new(size, theme::PAPER);
    let named = plot.groups.iter().enumerate().filter(|(_, g)| !g.label.is_empty());
    let legend: Vec<_> = named.map(|(i, g)| (g.label.clone(), Swatch::Fill(series_color(i)))).collect();
    let outer = draw_header(&mut canvas, size, &plot.title, &legend);

    let data = range_of(plot.groups.iter().flat_map(|g| g.values.iter().copied()));
    let frame = bar_frame(&mut canvas, plot, data, &outer, scale);
    if data.is_none() || plot.categories.is_empty() {
        draw_empty_note(&mut canvas, &frame.area, "no data", scale);
        return canvas.into_picture();
    }
    let row = frame.area.height / plot.categories.len() as f64;
    let thickness = (0.72 * row / plot.groups.len().max(1) as f64).min(2.2 * scale.line());
    let style = TextStyle::new(scale.body, theme::INK);
    for category in 0..plot.categories.len() {
        let middle = frame.area.top + (category as f64 + 0.5) * row;
        let top = middle - 0.5 * thickness * plot.groups.len() as f64;
        for (i, group) in plot.groups.iter().enumerate() {
            let Some(&value) = group.values.get(category).filter(|v| v.abs() <= LARGEST) else { continue };
            let clamped = value.clamp(frame.x.0, frame.x.1);
            let (zero, end) = (frame.px(0.0_f64.clamp(frame.x.0, frame.x.1)), frame.px(clamped));
            let bar = Area {
                left: zero.min(end),
                top: top + i as f64 * thickness,
                width: (end - zero).abs().max(1.0),
                height: (thickness - scale.unit).max(1.0),
            };
            canvas.fill_area(&bar, series_color(i));
            if thickness >= 0.8 * scale.line() {
                let text = format!("{} {}", short_number(value), plot.value.unit);
                let at = (bar.right() + 0.4 * scale.line(), bar.top + 0.5 * bar.height);
                canvas.text(at, text.trim_end(), Align::Start, &style);
            }
        }
    }
    canvas.into_picture()
}

/// The frame of a bar plot: names at the left, room for values at the right.
fn bar_frame(
    canvas: &mut Canvas,
    plot: &BarPlot,
    data: Option<(f64, f64)>,
    outer: &Area,
    scale: TypeScale,
) -> Frame {
    let style = TextStyle::new(scale.body, theme::INK);
    let line = scale.line();
    let names: Vec<String> = plot.categories.iter().map(|c| style.fitted(c, 0.4 * outer.width)).collect();
    let widest = names.iter().map(|n| style.width_of(n)).fold(0.0, f64::max);
    let left = outer.left + 0.8 * line + widest + 0.6 * line;
    let area = Area {
        left,
        top: outer.top + 0.5 * line,
        width: (outer.right() - left - line).max(8.0),
        height: (outer.height - 3.6 * line - 5.0 * scale.unit).max(8.0),
    };
    let value_texts = plot
        .groups
        .iter()
        .flat_map(|g| &g.values)
        .map(|v| style.width_of(&format!("{} {}", short_number(*v), plot.value.unit)));
    let room = (value_texts.fold(0.0, f64::max) + 0.8 * line).min(0.5 * area.width);
    let fixed = plot.value.range.is_some();
    let (low, mut high) = axis_range(&plot.value.clone().from_zero(), data, 0.02);
    if !fixed {
        // The longest bar leaves space for its value.
        high = low + (high - low) * area.width / (area.width - room);
        if low < 0.0 && high <= 0.0 {
            high = padded((low, high), 0.05).1;
        }
    }
    let mut ticks = Ticks::between(low, high, 6);
    let labels: Vec<_> = ticks.values.iter().map(|&v| (v, ticks.label(v))).collect();
    ticks = Ticks::between(low, high, intervals_that_fit(area.width, &labels, scale));
    let x = AxisFace::new(axis_title(&plot.value.label, &plot.value.unit), (low, high), &ticks);
    let y = AxisFace { title: String::new(), range: (0.0, 1.0), marks: Vec::new() };
    let frame = Frame { area, x: x.range, y: y.range };
    frame.draw(canvas, &x, &y, scale);
    let row = area.height / names.len().max(1) as f64;
    for (i, name) in names.iter().enumerate() {
        let at = (left - 0.6 * line, area.top + (i as f64 + 0.5) * row);
        canvas.text(at, name, Align::End, &style);
    }
    frame
}

#[cfg(test)]
mod tests;
