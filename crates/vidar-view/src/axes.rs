//! Common parts of all plots: header with title and legend, frame with grid and ticks, mapping from data to pixels.

use crate::canvas::{Area, Canvas, Pen, Rgb, theme};
use crate::size::{PictureSize, TypeScale};
use crate::text::{Align, TextStyle};
use crate::ticks::Ticks;

/// One axis, ready to be drawn.
pub(crate) struct AxisFace {
    /// Title with unit; may be empty.
    pub title: String,
    /// Data at the ends.
    pub range: (f64, f64),
    /// Positions (data) and labels of the ticks.
    pub marks: Vec<(f64, String)>,
}

impl AxisFace {
    pub(crate) fn new(title: String, range: (f64, f64), ticks: &Ticks) -> Self {
        Self { title, range, marks: ticks.values.iter().copied().zip(ticks.labels()).collect() }
    }
}

/// `label [unit]`; an empty part is omitted.
pub(crate) fn axis_title(label: &str, unit: &str) -> String {
    match (label.is_empty(), unit.is_empty()) {
        (_, true) => label.to_owned(),
        (true, false) => format!("[{unit}]"),
        (false, false) => format!("{label} [{unit}]"),
    }
}

/// Maps data to pixels within an area; y grows upwards.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Frame {
    pub area: Area,
    pub x: (f64, f64),
    pub y: (f64, f64),
}

impl Frame {
    pub(crate) fn px(&self, x: f64) -> f64 {
        self.area.left + (x - self.x.0) / (self.x.1 - self.x.0) * self.area.width
    }

    pub(crate) fn py(&self, y: f64) -> f64 {
        self.area.bottom() - (y - self.y.0) / (self.y.1 - self.y.0) * self.area.height
    }

    pub(crate) fn at(&self, x: f64, y: f64) -> (f64, f64) {
        (self.px(x), self.py(y))
    }

    /// Grid, border, ticks with labels, axis titles.
    pub(crate) fn draw(&self, canvas: &mut Canvas, x: &AxisFace, y: &AxisFace, scale: TypeScale) {
        let ink = TextStyle::new(scale.body, theme::INK);
        let grid = Pen::new(theme::GRID, scale.unit);
        let (area, unit, line) = (self.area, scale.unit, scale.line());
        let tick = 5.0 * unit;
        for (value, label) in &x.marks {
            let px = self.px(*value);
            canvas.rule([(px, area.top), (px, area.bottom())], grid);
            canvas.rule([(px, area.bottom()), (px, area.bottom() + tick)], Pen::new(theme::FRAME, unit));
            canvas.text((px, area.bottom() + tick + 0.6 * line), label, Align::Middle, &ink);
        }
        for (value, label) in &y.marks {
            let py = self.py(*value);
            canvas.rule([(area.left, py), (area.right(), py)], grid);
            canvas.rule([(area.left - tick, py), (area.left, py)], Pen::new(theme::FRAME, unit));
            canvas.text((area.left - tick - 3.0 * unit, py), label, Align::End, &ink);
        }
        canvas.outline(&area, Pen::new(theme::FRAME, unit));
        let below = area.bottom() + tick + 1.75 * line;
        let title = ink.fitted(&x.title, canvas.width());
        canvas.text((area.left + 0.5 * area.width, below), &title, Align::Middle, &ink);
        let title = ink.fitted(&y.title, area.height.max(4.0 * line));
        let beside = area.left - tick - 3.0 * unit - widest(&y.marks, &ink) - 0.9 * line;
        canvas.text_upwards((beside, area.top + 0.5 * area.height), &title, Align::Middle, &ink);
    }
}

fn widest(marks: &[(f64, String)], style: &TextStyle) -> f64 {
    marks.iter().map(|(_, l)| style.width_of(l)).fold(0.0, f64::max)
}

/// Margins for labels and titles around a frame: left, right, top, bottom.
pub(crate) struct Margins {
    pub left: f64,
    pub right: f64,
    pub top: f64,
    pub bottom: f64,
}

impl Margins {
    pub(crate) fn around(x: &AxisFace, y: &AxisFace, scale: TypeScale) -> Self {
        let ink = TextStyle::new(scale.body, theme::INK);
        let (line, unit) = (scale.line(), scale.unit);
        let y_title = if y.title.is_empty() { 0.0 } else { 1.4 * line };
        let x_title = if x.title.is_empty() { 0.0 } else { 1.2 * line };
        Self {
            left: y_title + widest(&y.marks, &ink) + 8.0 * unit + 0.6 * line,
            // Half of the last tick label may extend beyond the frame.
            right: (0.5 * widest(&x.marks, &ink)).max(0.8 * line),
            top: 0.6 * line,
            bottom: 5.0 * unit + 1.2 * line + x_title + 0.5 * line,
        }
    }

    /// The area of `outer` within the margins; at least a few pixels.
    pub(crate) fn inside(&self, outer: &Area) -> Area {
        Area {
            left: outer.left + self.left,
            top: outer.top + self.top,
            width: (outer.width - self.left - self.right).max(8.0),
            height: (outer.height - self.top - self.bottom).max(8.0),
        }
    }
}

/// How an entry of a legend is drawn.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Swatch {
    Line(Pen),
    Fill(Rgb),
    Dot(Rgb),
    Start(Rgb),
    End(Rgb),
}

/// Draws title and legend at the top and returns the area below.
pub(crate) fn draw_header(
    canvas: &mut Canvas,
    size: PictureSize,
    title: &str,
    legend: &[(String, Swatch)],
) -> Area {
    let scale = size.type_scale();
    let (line, side) = (scale.line(), 0.8 * scale.line());
    let room = canvas.width() - 2.0 * side;
    let mut top = 0.5 * line;
    if !title.is_empty() {
        let style = TextStyle::new(scale.title, theme::INK).bold();
        let height = scale.title.val() as f64;
        let text = style.fitted(title, room);
        canvas.text((side, top + 0.6 * height), &text, Align::Start, &style);
        top += 1.35 * height;
    }
    let style = TextStyle::new(scale.body, theme::INK);
    let gap = 1.4 * line;
    let mut left = side;
    for (i, (label, swatch)) in legend.iter().enumerate() {
        // A mark needs less space than a piece of line.
        let key = if matches!(swatch, Swatch::Line(_)) { 1.8 * line } else { 0.9 * line };
        let label = style.fitted(label, room - key - 0.4 * line);
        let width = key + 0.4 * line + style.width_of(&label);
        if i > 0 && left + width > side + room {
            left = side;
            top += 1.3 * line;
        }
        draw_swatch(canvas, *swatch, (left, top + 0.6 * line), key, scale.unit);
        canvas.text((left + key + 0.4 * line, top + 0.6 * line), &label, Align::Start, &style);
        left += width + gap;
    }
    if !legend.is_empty() {
        top += 1.3 * line;
    }
    Area { left: 0.0, top, width: canvas.width(), height: (canvas.height() - top).max(8.0) }
}

fn draw_swatch(canvas: &mut Canvas, swatch: Swatch, (left, centre): (f64, f64), width: f64, unit: f64) {
    let center = (left + 0.5 * width, centre);
    match swatch {
        Swatch::Line(pen) => canvas.polyline(&[(left, centre), (left + width, centre)], pen),
        Swatch::Fill(color) => {
            let side = 0.5 * width;
            let area =
                Area { left: left + 0.5 * side, top: centre - 0.4 * side, width: side, height: 0.8 * side };
            canvas.fill_area(&area, color);
        }
        Swatch::Dot(color) => canvas.disc(center, 3.5 * unit, color),
        Swatch::Start(color) => start_mark(canvas, center, color, unit),
        Swatch::End(color) => end_mark(canvas, center, color, unit),
    }
}

/// A ring: start of a path.
pub(crate) fn start_mark(canvas: &mut Canvas, at: (f64, f64), color: Rgb, unit: f64) {
    canvas.disc(at, 7.5 * unit, theme::PAPER);
    canvas.disc(at, 6.5 * unit, color);
    canvas.disc(at, 3.8 * unit, theme::PAPER);
}

/// A square: end of a path.
pub(crate) fn end_mark(canvas: &mut Canvas, (x, y): (f64, f64), color: Rgb, unit: f64) {
    for (half, color) in [(6.8 * unit, theme::PAPER), (5.6 * unit, color)] {
        canvas.polygon(
            &[(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)],
            color,
        );
    }
}

/// Writes in the centre of an area that there is no data.
pub(crate) fn draw_empty_note(canvas: &mut Canvas, area: &Area, text: &str, scale: TypeScale) {
    let style = TextStyle::new(scale.body, theme::QUIET_INK);
    let text = style.fitted(text, area.width);
    let at = (area.left + 0.5 * area.width, area.top + 0.5 * area.height);
    canvas.text(at, &text, Align::Middle, &style);
}
