//! A drawing surface over tiny-skia: anti-aliased lines and shapes in pixel coordinates, clipped by the picture.
//!
//! Coordinates are in pixels with (0, 0) at the *corner* of the top-left pixel, as vector graphics have it; only
//! images of depth and maps use the pixel-centre convention of the rest of the project.

use crate::{Picture, PictureSize};
use tiny_skia::{
    Color, FillRule, LineCap, LineJoin, Paint, PathBuilder, PixmapMut, Rect, Stroke, StrokeDash, Transform,
};

/// sRGB colour.
pub(crate) type Rgb = [u8; 3];

/// The colours every plot shares. Data colours are those of Okabe and Ito ("Color Universal Design", 2008), which
/// people with any common colour-vision deficiency can tell apart.
pub(crate) mod theme {
    use super::Rgb;
    pub(crate) const PAPER: Rgb = [255, 255, 255];
    pub(crate) const INK: Rgb = [34, 38, 43];
    pub(crate) const QUIET_INK: Rgb = [92, 99, 107];
    pub(crate) const FRAME: Rgb = [150, 156, 163];
    pub(crate) const GRID: Rgb = [228, 231, 234];
    pub(crate) const NO_DATA: Rgb = [58, 58, 60];
    pub(crate) const TRUTH: Rgb = [40, 40, 40];
    pub(crate) const DATA: [Rgb; 7] = [
        [0, 114, 178],
        [213, 94, 0],
        [0, 158, 115],
        [204, 121, 167],
        [230, 159, 0],
        [86, 180, 233],
        [120, 110, 60],
    ];
}

/// How a line is drawn.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pen {
    pub color: Rgb,
    pub width: f64,
    /// Lengths of stroke and gap, pixels.
    pub dash: Option<(f64, f64)>,
}

impl Pen {
    pub(crate) fn new(color: Rgb, width: f64) -> Self {
        Self { color, width, dash: None }
    }

    pub(crate) fn dashed(self, stroke: f64, gap: f64) -> Self {
        Self { dash: Some((stroke, gap)), ..self }
    }
}

/// A rectangle in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Area {
    pub left: f64,
    pub top: f64,
    pub width: f64,
    pub height: f64,
}

impl Area {
    pub(crate) fn right(&self) -> f64 {
        self.left + self.width
    }

    pub(crate) fn bottom(&self) -> f64 {
        self.top + self.height
    }
}

/// An opaque picture being drawn.
pub(crate) struct Canvas {
    width: usize,
    height: usize,
    /// RGBA, opaque.
    data: Vec<u8>,
}

impl Canvas {
    pub(crate) fn new(size: PictureSize, background: Rgb) -> Self {
        Self::of(size.width(), size.height(), background)
    }

    /// A canvas of any size, for pictures that follow an image's size.
    pub(crate) fn of(width: usize, height: usize, background: Rgb) -> Self {
        let [r, g, b] = background;
        let mut data = Vec::with_capacity(width * height * 4);
        for _ in 0..width * height {
            data.extend_from_slice(&[r, g, b, 255]);
        }
        Self { width, height, data }
    }

    pub(crate) fn width(&self) -> f64 {
        self.width as f64
    }

    pub(crate) fn height(&self) -> f64 {
        self.height as f64
    }

    pub(crate) fn into_picture(self) -> Picture {
        let data = &self.data;
        Picture::from_fn(self.width, self.height, |x, y| {
            let i = (y * self.width + x) * 4;
            [data[i], data[i + 1], data[i + 2]]
        })
    }

    /// Copies `picture` with its top-left corner at pixel `(left, top)`; what lies outside is left out.
    pub(crate) fn blit(&mut self, picture: &Picture, left: usize, top: usize) {
        for y in 0..picture.height().min(self.height.saturating_sub(top)) {
            for x in 0..picture.width().min(self.width.saturating_sub(left)) {
                let i = ((top + y) * self.width + left + x) * 4;
                self.data[i..i + 3].copy_from_slice(&picture[(x, y)]);
            }
        }
    }

    /// Mixes `color` into a pixel with weight `coverage` / 255.
    pub(crate) fn blend(&mut self, x: i64, y: i64, color: Rgb, coverage: u8) {
        if x < 0 || y < 0 || x >= self.width as i64 || y >= self.height as i64 {
            return;
        }
        let i = (y as usize * self.width + x as usize) * 4;
        let a = u32::from(coverage);
        for (channel, &c) in self.data[i..i + 3].iter_mut().zip(&color) {
            *channel = ((u32::from(*channel) * (255 - a) + u32::from(c) * a + 127) / 255) as u8;
        }
    }

    fn pixmap(&mut self) -> Option<PixmapMut<'_>> {
        PixmapMut::from_bytes(&mut self.data, self.width as u32, self.height as u32)
    }

    /// A filled rectangle with sharp edges (snapped to whole pixels).
    pub(crate) fn fill_area(&mut self, area: &Area, color: Rgb) {
        let (l, t) = (area.left.round(), area.top.round());
        let (r, b) = (area.right().round(), area.bottom().round());
        let Some(rect) = Rect::from_ltrb(l as f32, t as f32, r as f32, b as f32) else { return };
        let paint = flat(color, false);
        if let Some(mut pixmap) = self.pixmap() {
            pixmap.fill_rect(rect, &paint, Transform::identity(), None);
        }
    }

    /// Mixes `color` over a rectangle of whole pixels with weight `coverage` / 255: paper behind a label on a busy plot.
    pub(crate) fn veil(&mut self, area: &Area, color: Rgb, coverage: u8) {
        for y in area.top.round() as i64..area.bottom().round() as i64 {
            for x in area.left.round() as i64..area.right().round() as i64 {
                self.blend(x, y, color, coverage);
            }
        }
    }

    /// The outline of a rectangle, sharp.
    pub(crate) fn outline(&mut self, area: &Area, pen: Pen) {
        let (l, t, r, b) = (area.left, area.top, area.right(), area.bottom());
        for ends in [[(l, t), (r, t)], [(l, b), (r, b)], [(l, t), (l, b)], [(r, t), (r, b)]] {
            self.rule(ends, pen);
        }
    }

    /// A horizontal or vertical line, snapped to whole pixels so that it is sharp.
    pub(crate) fn rule(&mut self, [(x0, y0), (x1, y1)]: [(f64, f64); 2], pen: Pen) {
        let width = pen.width.round().max(1.0);
        let offset = (width / 2.0).floor();
        if pen.dash.is_some() {
            let snap = |v: f64| v.round() - offset + width / 2.0;
            return self.polyline(&[(snap(x0), snap(y0)), (snap(x1), snap(y1))], Pen { width, ..pen });
        }
        let (left, top) = (x0.min(x1).round() - offset, y0.min(y1).round() - offset);
        let (right, bottom) = (x0.max(x1).round() - offset + width, y0.max(y1).round() - offset + width);
        self.fill_area(&Area { left, top, width: right - left, height: bottom - top }, pen.color);
    }

    /// An open line through `points`, round at joints and ends.
    ///
    /// Long lines are stroked piece by piece: the filler keeps the edges that cross a row in a sorted list, and a
    /// path that winds over itself a hundred thousand times would take it minutes in one go.
    pub(crate) fn polyline(&mut self, points: &[(f64, f64)], pen: Pen) {
        const PIECE: usize = 128;
        // A dashed line starts its pattern anew at each piece, so it stays whole; those drawn here are short.
        if pen.dash.is_some() || points.len() <= PIECE {
            return self.stroke(points, pen);
        }
        for start in (0..points.len() - 1).step_by(PIECE - 1) {
            self.stroke(&points[start..points.len().min(start + PIECE)], pen);
        }
    }

    fn stroke(&mut self, points: &[(f64, f64)], pen: Pen) {
        let mut path = PathBuilder::new();
        for (i, &(x, y)) in points.iter().enumerate() {
            let (x, y) = (x as f32, y as f32);
            if i == 0 { path.move_to(x, y) } else { path.line_to(x, y) }
        }
        let Some(path) = path.finish() else { return };
        let cap = if pen.dash.is_some() { LineCap::Butt } else { LineCap::Round };
        let dash = pen.dash.and_then(|(on, off)| StrokeDash::new(vec![on as f32, off as f32], 0.0));
        let stroke = Stroke {
            width: pen.width as f32,
            line_cap: cap,
            line_join: LineJoin::Round,
            dash,
            ..Stroke::default()
        };
        let paint = flat(pen.color, true);
        if let Some(mut pixmap) = self.pixmap() {
            pixmap.stroke_path(&path, &paint, &stroke, Transform::identity(), None);
        }
    }

    /// A filled polygon.
    pub(crate) fn polygon(&mut self, points: &[(f64, f64)], color: Rgb) {
        let mut path = PathBuilder::new();
        for (i, &(x, y)) in points.iter().enumerate() {
            if i == 0 { path.move_to(x as f32, y as f32) } else { path.line_to(x as f32, y as f32) }
        }
        path.close();
        if let Some(path) = path.finish() {
            self.fill(&path, color);
        }
    }

    /// A filled disc.
    pub(crate) fn disc(&mut self, (x, y): (f64, f64), radius: f64, color: Rgb) {
        if let Some(path) = PathBuilder::from_circle(x as f32, y as f32, radius as f32) {
            self.fill(&path, color);
        }
    }

    fn fill(&mut self, path: &tiny_skia::Path, color: Rgb) {
        let paint = flat(color, true);
        if let Some(mut pixmap) = self.pixmap() {
            pixmap.fill_path(path, &paint, FillRule::Winding, Transform::identity(), None);
        }
    }
}

fn flat(color: Rgb, anti_alias: bool) -> Paint<'static> {
    let mut paint = Paint { anti_alias, ..Paint::default() };
    paint.set_color(Color::from_rgba8(color[0], color[1], color[2], 255));
    paint
}

/// The part of a segment inside `area` (Liang and Barsky 1984), or `None`.
pub(crate) fn clip_segment(area: &Area, a: (f64, f64), b: (f64, f64)) -> Option<[(f64, f64); 2]> {
    let (dx, dy) = (b.0 - a.0, b.1 - a.1);
    let (mut from, mut to) = (0.0_f64, 1.0_f64);
    let sides =
        [(-dx, a.0 - area.left), (dx, area.right() - a.0), (-dy, a.1 - area.top), (dy, area.bottom() - a.1)];
    for (rate, distance) in sides {
        if rate == 0.0 {
            if distance < 0.0 {
                return None;
            }
        } else if rate < 0.0 {
            from = from.max(distance / rate);
        } else {
            to = to.min(distance / rate);
        }
    }
    (from <= to).then_some([(a.0 + from * dx, a.1 + from * dy), (a.0 + to * dx, a.1 + to * dy)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rules_are_sharp_and_lie_where_asked() {
        let mut canvas = Canvas::new(PictureSize::new(160, 160), [255; 3]);
        canvas.rule([(10.0, 20.0), (50.0, 20.0)], Pen::new([0; 3], 1.0));
        let picture = canvas.into_picture();
        for x in 11..50 {
            assert_eq!(picture[(x, 20)], [0; 3]);
            assert_eq!(picture[(x, 19)], [255; 3]);
            assert_eq!(picture[(x, 21)], [255; 3]);
        }
    }

    #[test]
    fn segments_are_clipped_where_they_cross_the_border() {
        let area = Area { left: 0.0, top: 0.0, width: 10.0, height: 10.0 };
        assert_eq!(clip_segment(&area, (-5.0, 5.0), (15.0, 5.0)), Some([(0.0, 5.0), (10.0, 5.0)]));
        assert_eq!(clip_segment(&area, (2.0, 3.0), (4.0, 5.0)), Some([(2.0, 3.0), (4.0, 5.0)]));
        assert_eq!(clip_segment(&area, (-5.0, -1.0), (15.0, -1.0)), None);
        assert_eq!(clip_segment(&area, (11.0, 0.0), (12.0, 5.0)), None);
    }
}
