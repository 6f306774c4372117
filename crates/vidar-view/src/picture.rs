//! Pictures of depth and confidence, and pictures side by side.

use crate::Picture;
use crate::canvas::{Area, Canvas, Pen, theme};
use crate::colormap::ColorMap;
use crate::size::{PictureSize, TypeScale};
use crate::text::{Align, TextStyle};
use crate::ticks::Ticks;
use vidar_core::Image;

/// Narrower images are enlarged by a whole factor to about this many columns, so that the colour scale fits.
const SMALLEST_WIDTH: usize = 320;

/// A picture of z-depth with a scale in metres: near is bright, far is dark, no depth is dark grey.
///
/// `range` is (near, far) in metres; `None` takes the 1st and 99th percentile of the image. Images narrower than
/// 320 columns are enlarged by a whole factor; larger than 8192 are thinned.
pub fn depth_picture(depth: &Image<f32>, range: Option<(f32, f32)>) -> Picture {
    let valid = |z: f32| z.is_finite() && z > 0.0;
    let chosen = range.filter(|(n, f)| n.is_finite() && f.is_finite() && n < f);
    let (near, far) = chosen.unwrap_or_else(|| robust_range(depth, valid));
    let shade = move |z: f32| if valid(z) { (far - z) / (far - near) } else { f32::NAN };
    let colours = depth.map(|&z| ColorMap::Sea.color(shade(z)));
    with_color_bar(&colours, "z-depth [m]", (f64::from(near), f64::from(far)), |v| {
        ColorMap::Sea.color(shade((v as f32).max(f32::MIN_POSITIVE)))
    })
}

/// A picture of confidence 0…1 with its scale: high is bright, low is dark, NaN is dark grey.
pub fn confidence_picture(confidence: &Image<f32>) -> Picture {
    let colours = confidence.map(|&c| ColorMap::Sea.color(c));
    with_color_bar(&colours, "confidence", (0.0, 1.0), |v| ColorMap::Sea.color(v as f32))
}

/// 1st and 99th percentile of the valid values, opened where they coincide.
pub(crate) fn robust_range(image: &Image<f32>, valid: impl Fn(f32) -> bool) -> (f32, f32) {
    // A million samples are enough for a percentile.
    let stride = (image.data().len() / 1_000_000).max(1);
    let mut values: Vec<f32> = image.data().iter().step_by(stride).copied().filter(|&v| valid(v)).collect();
    values.sort_unstable_by(f32::total_cmp);
    let Some(last) = values.len().checked_sub(1) else { return (0.0, 1.0) };
    let (low, high) = (values[last / 100], values[last - last / 100]);
    let least = (1e-3 * high.abs()).max(1e-6);
    if high - low < least { ((low - least).max(0.0), high + least) } else { (low, high) }
}

/// `colours` with a vertical scale at its right; values rise upwards.
fn with_color_bar(
    colours: &Picture,
    title: &str,
    range: (f64, f64),
    color: impl Fn(f64) -> [u8; 3],
) -> Picture {
    let shown = viewable(colours);
    let (width, height) = (shown.width(), shown.height().max(PictureSize::MIN));
    let scale = TypeScale::for_extent(width.min(height * 4 / 3));
    let (line, unit) = (scale.line(), scale.unit);
    let rows = (height as f64 / (2.6 * line)).clamp(2.0, 10.0) as usize;
    let ticks = Ticks::between(range.0, range.1, rows);
    let style = TextStyle::new(scale.body, theme::INK);
    let widest = ticks.labels().iter().map(|l| style.width_of(l)).fold(0.0, f64::max);
    let margin = 0.7 * line;
    let strip = margin + 1.1 * line + 8.0 * unit + widest + 1.6 * line + 0.2 * line;

    let mut canvas = Canvas::of(width + strip.ceil() as usize, height, theme::PAPER);
    canvas.blit(&shown, 0, 0);
    let area = Area {
        left: width as f64 + margin,
        top: 0.6 * line,
        width: 1.1 * line,
        height: height as f64 - 1.2 * line,
    };
    draw_color_bar(&mut canvas, &area, range, color, unit);
    for value in &ticks.values {
        let y = area.bottom() - (value - range.0) / (range.1 - range.0) * area.height;
        canvas.rule([(area.right(), y), (area.right() + 5.0 * unit, y)], Pen::new(theme::FRAME, unit));
        canvas.text((area.right() + 8.0 * unit, y), &ticks.label(*value), Align::Start, &style);
    }
    let beside = area.right() + 8.0 * unit + widest + 0.9 * line;
    let title = style.fitted(title, area.height + line);
    canvas.text_upwards((beside, 0.5 * height as f64), &title, Align::Middle, &style);
    canvas.into_picture()
}

fn draw_color_bar(
    canvas: &mut Canvas,
    area: &Area,
    range: (f64, f64),
    color: impl Fn(f64) -> [u8; 3],
    unit: f64,
) {
    let (top, bottom) = (area.top.round() as usize, area.bottom().round() as usize);
    for y in top..bottom {
        let share = 1.0 - (y - top) as f64 / (bottom - top - 1).max(1) as f64;
        let row = Area { left: area.left, top: y as f64, width: area.width, height: 1.0 };
        canvas.fill_area(&row, color(range.0 + share * (range.1 - range.0)));
    }
    canvas.outline(area, Pen::new(theme::FRAME, unit));
}

/// The picture enlarged or thinned by whole factors to a size suitable for viewing.
fn viewable(picture: &Picture) -> Picture {
    let (w, h) = (picture.width().max(1), picture.height().max(1));
    if picture.data().is_empty() {
        return Picture::filled(SMALLEST_WIDTH, SMALLEST_WIDTH * 3 / 4, theme::NO_DATA);
    }
    let larger = SMALLEST_WIDTH.div_ceil(w).min(PictureSize::MAX / h).max(1);
    let smaller = w.max(h).div_ceil(PictureSize::MAX);
    let (columns, rows) = ((w * larger).div_ceil(smaller), (h * larger).div_ceil(smaller));
    Picture::from_fn(columns, rows, |x, y| picture[(x * smaller / larger, y * smaller / larger)])
}

/// Pictures in a row with captions above, brought to the height of the tallest (at most 8192).
///
/// Captions that are wider than their picture are cut with an ellipsis. No pictures give a small empty one.
pub fn side_by_side(items: &[(&str, &Picture)]) -> Picture {
    let tallest = items.iter().map(|(_, p)| p.height()).max().unwrap_or(0).clamp(1, PictureSize::MAX);
    let scaled: Vec<(&str, Picture)> = items
        .iter()
        .filter(|(_, p)| !p.data().is_empty())
        .map(|(c, p)| (*c, at_height(p, tallest)))
        .collect();
    let widest = scaled.iter().map(|(_, p)| p.width()).max().unwrap_or(PictureSize::MIN);
    let scale = TypeScale::for_extent(widest.min(tallest * 4 / 3));
    let line = scale.line();
    let (gap, head) = (0.6 * line, 1.6 * line);
    let width: usize = scaled.iter().map(|(_, p)| p.width()).sum();
    let gaps = gap * (scaled.len() as f64 + 1.0);
    let width = (width + gaps.ceil() as usize).max(PictureSize::MIN);
    let height = tallest + (head + gap).ceil() as usize;

    let mut canvas = Canvas::of(width, height, theme::PAPER);
    let style = TextStyle::new(scale.body, theme::INK);
    let mut left = gap;
    for (caption, picture) in &scaled {
        let text = style.fitted(caption, picture.width() as f64);
        canvas.text((left.round(), 0.55 * head), &text, Align::Start, &style);
        canvas.blit(picture, left.round() as usize, head as usize);
        left += picture.width() as f64 + gap;
    }
    canvas.into_picture()
}

/// The picture resized to a height: bilinear when enlarging, box average when reducing.
fn at_height(picture: &Picture, height: usize) -> Picture {
    if picture.height() == height {
        return picture.clone();
    }
    let factor = picture.height() as f64 / height as f64;
    let width = ((picture.width() as f64 / factor).round() as usize).clamp(1, PictureSize::MAX);
    let factor_x = picture.width() as f64 / width as f64;
    let columns: Vec<_> = (0..width).map(|x| taps(x, factor_x, picture.width())).collect();
    Picture::from_fn(width, height, |x, y| {
        let mut sum = [0.0; 3];
        let mut total = 0.0;
        for &(sy, wy) in &taps(y, factor, picture.height()) {
            for &(sx, wx) in &columns[x] {
                let weight = wx * wy;
                total += weight;
                for (s, &p) in sum.iter_mut().zip(&picture[(sx, sy)]) {
                    *s += weight * f64::from(p);
                }
            }
        }
        sum.map(|s| (s / total).round() as u8)
    })
}

/// Source pixels and weights of one output pixel: a triangle as wide as the larger of the two pixel sizes.
fn taps(i: usize, factor: f64, count: usize) -> Vec<(usize, f64)> {
    let center = (i as f64 + 0.5) * factor - 0.5;
    let reach = factor.max(1.0);
    let (first, last) = ((center - reach).ceil().max(0.0), (center + reach).floor().min(count as f64 - 1.0));
    let weighted = (first as usize..=last.max(first) as usize)
        .map(|s| (s.min(count - 1), 1.0 - (s as f64 - center).abs() / reach))
        .filter(|t| t.1 > 1e-9);
    let taps: Vec<_> = weighted.collect();
    if taps.is_empty() { vec![((center.round().max(0.0) as usize).min(count - 1), 1.0)] } else { taps }
}

#[cfg(test)]
mod tests;
