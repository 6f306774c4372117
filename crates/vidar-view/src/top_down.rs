//! Paths seen from above (and from the side), with the same scale on all axes.

use crate::Picture;
use crate::axes::{AxisFace, Frame, Margins, Swatch, draw_empty_note, draw_header, end_mark, start_mark};
use crate::canvas::{Area, Canvas, Pen, Rgb, theme};
use crate::lines::{draw_clipped, intervals_that_fit, rows_that_fit};
use crate::map::camera::HorizontalPlane;
use crate::size::{PictureSize, TypeScale};
use crate::text::{Align, TextStyle};
use crate::ticks::{LARGEST, Ticks, nice_step, range_of};
use nalgebra::Vector3;
use vidar_core::Trajectory;

/// Role of a path; sets its style.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum TrajectoryRole {
    /// A result: coloured, in front.
    #[default]
    Estimate,
    /// The reference: dark, wide, behind.
    GroundTruth,
}

/// A path with its name in the legend.
#[derive(Clone, Copy, Debug)]
pub struct PlotTrajectory<'a> {
    /// Name in the legend.
    pub label: &'a str,
    /// What it is.
    pub role: TrajectoryRole,
    /// The path.
    pub trajectory: &'a Trajectory,
}

impl<'a> PlotTrajectory<'a> {
    /// A result.
    pub fn estimate(label: &'a str, trajectory: &'a Trajectory) -> Self {
        Self { label, role: TrajectoryRole::Estimate, trajectory }
    }

    /// The reference.
    pub fn ground_truth(label: &'a str, trajectory: &'a Trajectory) -> Self {
        Self { label, role: TrajectoryRole::GroundTruth, trajectory }
    }
}

/// How paths are drawn.
#[derive(Clone, Debug, PartialEq)]
pub struct TrajectoryPlot {
    /// Title; may be empty.
    pub title: String,
    /// Up in the world; see [`crate::up_of_world`] where the world is not known to have z up.
    pub up: Vector3<f64>,
    /// Whether a panel below shows the height, at the same scale.
    pub side_view: bool,
}

impl Default for TrajectoryPlot {
    fn default() -> Self {
        Self { title: "Trajectory, seen from above".to_owned(), up: Vector3::z(), side_view: true }
    }
}

/// Paths from above and from the side in a world with z up. See [`plot_trajectories`].
pub fn plot_trajectories_top_down(items: &[PlotTrajectory<'_>], size: PictureSize) -> Picture {
    plot_trajectories(items, &TrajectoryPlot::default(), size)
}

/// Paths from above: metres with equal scale on both axes, start (ring) and end (square) of each path, scale bar.
///
/// Where two poses lie further apart in time than five median intervals, the path was not observed there and the
/// connecting line is dashed.
pub fn plot_trajectories(items: &[PlotTrajectory<'_>], plot: &TrajectoryPlot, size: PictureSize) -> Picture {
    let scale = size.type_scale();
    let plane = HorizontalPlane::of_up(&plot.up);
    let paths = coloured_paths(items, &plane);
    let mut canvas = Canvas::new(size, theme::PAPER);
    let below = draw_header(&mut canvas, size, &plot.title, &legend(items, &paths, scale));

    let panels = Panels::layout(&paths, &plane, plot.side_view, &below, scale);
    panels.top.draw(&mut canvas, &panels.top_x, &panels.top_y, scale);
    draw_paths(&mut canvas, &panels.top, &paths, 1, scale);
    if let Some((side, x, y)) = &panels.side {
        side.draw(&mut canvas, x, y, scale);
        draw_paths(&mut canvas, side, &paths, 2, scale);
    }
    if paths.iter().all(|p| p.points.is_empty()) {
        draw_empty_note(&mut canvas, &panels.top.area, "no poses", scale);
    } else {
        draw_scale_bar(&mut canvas, &panels.top, scale);
    }
    canvas.into_picture()
}

/// A path in the plot's own axes.
struct Path {
    color: Rgb,
    width: f64,
    /// Horizontal, horizontal, up; metres.
    points: Vec<[f64; 3]>,
    /// Whether the line from the point before was observed.
    joined: Vec<bool>,
}

/// Ground truth first, so that results lie on top.
fn coloured_paths(items: &[PlotTrajectory<'_>], plane: &HorizontalPlane) -> Vec<Path> {
    let mut estimates = 0;
    let mut paths: Vec<(bool, Path)> = Vec::new();
    for item in items {
        let is_truth = item.role == TrajectoryRole::GroundTruth;
        let (color, width) = if is_truth {
            (theme::TRUTH, 3.0)
        } else {
            estimates += 1;
            (theme::DATA[(estimates - 1) % theme::DATA.len()], 2.0)
        };
        let gap_ns = longest_usual_gap_ns(item.trajectory);
        let (mut points, mut joined) = (Vec::new(), Vec::new());
        let mut previous_ns: Option<i64> = None;
        for stamped in item.trajectory.poses() {
            let point = plane.coordinates(&stamped.world_from_body.translation);
            if point.iter().any(|v| !(v.abs() <= LARGEST)) {
                continue;
            }
            let ns = stamped.time.nanos();
            joined.push(previous_ns.is_some_and(|p| ns.saturating_sub(p) <= gap_ns));
            points.push(point);
            previous_ns = Some(ns);
        }
        paths.push((is_truth, Path { color, width, points, joined }));
    }
    paths.sort_by_key(|(is_truth, _)| !is_truth);
    paths.into_iter().map(|(_, p)| p).collect()
}

fn longest_usual_gap_ns(trajectory: &Trajectory) -> i64 {
    let mut gaps: Vec<i64> =
        trajectory.poses().windows(2).map(|w| w[1].time.nanos().saturating_sub(w[0].time.nanos())).collect();
    gaps.sort_unstable();
    gaps.get(gaps.len() / 2).map_or(i64::MAX, |median| median.saturating_mul(5))
}

fn legend(items: &[PlotTrajectory<'_>], paths: &[Path], scale: TypeScale) -> Vec<(String, Swatch)> {
    // `paths` has ground truth first, each group in the order of `items`.
    let truth = items.iter().filter(|i| i.role == TrajectoryRole::GroundTruth);
    let rest = items.iter().filter(|i| i.role == TrajectoryRole::Estimate);
    let mut entries: Vec<_> = truth
        .chain(rest)
        .zip(paths)
        .map(|(i, p)| (i.label.to_owned(), Swatch::Line(Pen::new(p.color, p.width * scale.unit))))
        .collect();
    if !entries.is_empty() {
        entries.push(("start".to_owned(), Swatch::Start(theme::QUIET_INK)));
        entries.push(("end".to_owned(), Swatch::End(theme::QUIET_INK)));
    }
    entries
}

struct Panels {
    top: Frame,
    top_x: AxisFace,
    top_y: AxisFace,
    side: Option<(Frame, AxisFace, AxisFace)>,
}

impl Panels {
    /// Two frames with one number of pixels per metre, as large as they fit, sharing the horizontal axis.
    fn layout(paths: &[Path], plane: &HorizontalPlane, side: bool, outer: &Area, scale: TypeScale) -> Self {
        let spans: [(f64, f64); 3] = std::array::from_fn(|axis| {
            widened(range_of(paths.iter().flat_map(|p| p.points.iter().map(move |q| q[axis]))))
        });
        let titles: [String; 3] = std::array::from_fn(|axis| format!("{} [m]", plane.names[axis]));
        // Margins from estimated labels; the same labels are drawn later with a step that fits.
        let widest = spans.iter().map(|s| s.1 - s.0).fold(0.0, f64::max);
        let guess = nice_step(widest, 8);
        let face = |axis: usize, range: (f64, f64), step: f64| {
            AxisFace::new(titles[axis].clone(), range, &Ticks::with_step(range.0, range.1, step))
        };
        let (x, y, z) = (face(0, spans[0], guess), face(1, spans[1], guess), face(2, spans[2], guess));
        let mut margins = Margins::around(&x, &y, scale);
        let z_margins = Margins::around(&x, &z, scale);
        margins.left = margins.left.max(z_margins.left);
        let length = |axis: usize| spans[axis].1 - spans[axis].0;

        let width = outer.width - margins.left - margins.right;
        let room = outer.height - margins.top - margins.bottom;
        // Marks at the ends of a flat path need space above and below.
        let air = 20.0 * scale.unit;
        let both = room - margins.top - margins.bottom - air;
        let with_side = side && both > 6.0 * scale.line();
        let (height, metres) = if with_side { (both, length(1) + length(2)) } else { (room, length(1)) };
        let per_metre = (width / length(0)).min(height / metres).max(1e-12);
        // Remaining height goes to the top view; remaining width widens both views.
        let side_height = if with_side { (length(2) * per_metre).max(3.0 * scale.line()) + air } else { 0.0 };
        let top_height = (if with_side { height + air } else { height } - side_height).max(8.0);
        let (left, width) = (outer.left + margins.left, width.max(8.0));
        let fit = |axis: usize, pixels: f64| centred(spans[axis], pixels / per_metre);

        let x_range = fit(0, width);
        let top_area = Area { left, top: outer.top + margins.top, width, height: top_height };
        let top = Frame { area: top_area, x: x_range, y: fit(1, top_height) };
        let columns = intervals_that_fit(width, &x.marks, scale);
        let rows = rows_that_fit(top_height, scale);
        // One step for all axes: the grid is made of squares.
        let step = nice_step(x_range.1 - x_range.0, columns).max(nice_step(top.y.1 - top.y.0, rows));
        let side = with_side.then(|| {
            let top = top_area.bottom() + margins.bottom + margins.top;
            let frame = Frame {
                area: Area { left, top, width, height: side_height },
                x: x_range,
                y: fit(2, side_height),
            };
            let own = nice_step(frame.y.1 - frame.y.0, rows_that_fit(side_height, scale).max(2));
            (frame, face(0, x_range, step), face(2, frame.y, own.min(step)))
        });
        Self { top_x: face(0, x_range, step), top_y: face(1, top.y, step), top, side }
    }
}

/// A range with a margin; a path without extent gets one metre around it.
fn widened(range: Option<(f64, f64)>) -> (f64, f64) {
    let Some((low, high)) = range else { return (-1.0, 1.0) };
    let span = high - low;
    if span <= 1e-6 + 1e-9 * low.abs().max(high.abs()) {
        let half = 0.5_f64.max(1e-6 * low.abs().max(high.abs()));
        return (low - half, high + half);
    }
    (low - 0.06 * span, high + 0.06 * span)
}

fn centred((low, high): (f64, f64), length: f64) -> (f64, f64) {
    let middle = 0.5 * (low + high);
    (middle - 0.5 * length, middle + 0.5 * length)
}

/// Draws the paths with axis 0 to the right and `up_axis` upwards.
fn draw_paths(canvas: &mut Canvas, frame: &Frame, paths: &[Path], up_axis: usize, scale: TypeScale) {
    for path in paths {
        let pixels: Vec<_> = path.points.iter().map(|p| frame.at(p[0], p[up_axis])).collect();
        let pen = Pen::new(path.color, path.width * scale.unit);
        let mut from = 0;
        for i in 1..=pixels.len() {
            if i == pixels.len() || !path.joined[i] {
                draw_clipped(canvas, &frame.area, &simplified(&pixels[from..i]), pen);
                if i < pixels.len() {
                    let gap =
                        Pen { width: 0.6 * pen.width, ..pen }.dashed(4.0 * scale.unit, 4.0 * scale.unit);
                    draw_clipped(canvas, &frame.area, &pixels[i - 1..=i], gap);
                }
                from = i;
            }
        }
    }
    for path in paths {
        if let (Some(first), Some(last)) = (path.points.first(), path.points.last()) {
            end_mark(canvas, frame.at(last[0], last[up_axis]), path.color, scale.unit);
            start_mark(canvas, frame.at(first[0], first[up_axis]), path.color, scale.unit);
        }
    }
}

/// Leaves out points closer than a third of a pixel to the last one kept.
fn simplified(pixels: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut kept: Vec<(f64, f64)> = Vec::new();
    for (i, &p) in pixels.iter().enumerate() {
        let far = kept.last().is_none_or(|l| (p.0 - l.0).hypot(p.1 - l.1) > 0.33);
        if far || i + 1 == pixels.len() {
            kept.push(p);
        }
    }
    kept
}

/// A bar of 1, 2 or 5 times a power of ten metres in the lower right corner.
fn draw_scale_bar(canvas: &mut Canvas, frame: &Frame, scale: TypeScale) {
    let per_metre = frame.area.width / (frame.x.1 - frame.x.0);
    scale_bar(canvas, &frame.area, per_metre, scale);
}

/// A scale bar in the lower right corner of an area that shows `per_metre` pixels per metre.
pub(crate) fn scale_bar(canvas: &mut Canvas, area: &Area, per_metre: f64, scale: TypeScale) {
    // At most a fifth of the width: `nice_step` rounds up, so a tenth is asked for.
    let metres = nice_step(area.width / per_metre / 10.0, 1);
    let length = metres * per_metre;
    let (unit, line) = (scale.unit, scale.line());
    let (right, y) = (area.right() - 0.8 * line, area.bottom() - 0.8 * line);
    let left = right - length;
    let label = metres_label(metres);
    let style = TextStyle::new(scale.body, theme::INK);
    let text_width = style.width_of(&label);
    let wide = length.max(text_width);
    let middle = right - 0.5 * wide;
    let halo = Area {
        left: right - wide - 0.4 * line,
        top: y - 1.5 * line,
        width: wide + 0.8 * line,
        height: 1.9 * line,
    };
    canvas.veil(&halo, theme::PAPER, 215);
    let shift = 0.5 * (wide - length);
    let pen = Pen::new(theme::INK, 2.0 * unit);
    let (left, right) = (left - shift, right - shift);
    canvas.rule([(left, y), (right, y)], pen);
    for end in [left, right] {
        canvas.rule([(end, y - 4.0 * unit), (end, y + 4.0 * unit)], pen);
    }
    canvas.text((middle, y - 0.85 * line), &label, Align::Middle, &style);
}

fn metres_label(metres: f64) -> String {
    match metres {
        m if m >= 1000.0 => format!("{} km", m / 1000.0),
        m if m >= 1.0 => format!("{m} m"),
        m if m >= 0.01 => format!("{} cm", (m * 100.0).round()),
        m => format!("{} mm", m * 1000.0),
    }
}

#[cfg(test)]
mod tests;
