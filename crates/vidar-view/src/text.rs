//! Text from pre-rasterised glyphs (Noto Sans Mono): no font file, no system library, the same pixels everywhere.

use crate::canvas::{Canvas, Rgb};
use noto_sans_mono_bitmap::{FontWeight, RasterHeight, RasterizedChar, get_raster, get_raster_width};

/// Which part of the text is at the given position, along the text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Align {
    Start,
    Middle,
    End,
}

/// Style of a text.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TextStyle {
    pub height: RasterHeight,
    pub weight: FontWeight,
    pub color: Rgb,
}

impl TextStyle {
    pub(crate) fn new(height: RasterHeight, color: Rgb) -> Self {
        Self { height, weight: FontWeight::Regular, color }
    }

    pub(crate) fn bold(self) -> Self {
        Self { weight: FontWeight::Bold, ..self }
    }

    fn glyph_width(&self) -> usize {
        get_raster_width(self.weight, self.height)
    }

    /// Width of `text`, pixels.
    pub(crate) fn width_of(&self, text: &str) -> f64 {
        (printable(text).chars().count() * self.glyph_width()) as f64
    }

    /// `text`, cut with `...` where it is wider than `width` pixels.
    pub(crate) fn fitted(&self, text: &str, width: f64) -> String {
        let text = printable(text);
        let room = (width / self.glyph_width() as f64).max(0.0) as usize;
        if text.chars().count() <= room {
            return text;
        }
        let kept: String = text.chars().take(room.saturating_sub(3)).collect();
        format!("{}...", kept.trim_end()).chars().take(room).collect()
    }

    fn glyph(&self, c: char) -> Option<RasterizedChar> {
        get_raster(c, self.weight, self.height)
    }
}

/// `text` in characters the font has: typographic characters become ASCII, any other character a `?`.
fn printable(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '\u{2212}' | '\u{2013}' | '\u{2014}' | '\u{2010}' | '\u{2011}' => out.push('-'),
            '\u{2018}' | '\u{2019}' => out.push('\''),
            '\u{201c}' | '\u{201d}' => out.push('"'),
            '\u{2026}' => out.push_str("..."),
            '\u{2264}' => out.push_str("<="),
            '\u{2265}' => out.push_str(">="),
            '\u{3c3}' => out.push_str("sigma"),
            '\u{394}' => out.push('d'),
            '\u{3bc}' => out.push('\u{b5}'),
            c if c.is_control() => out.push(' '),
            c if TextStyle::new(RasterHeight::Size16, [0; 3]).glyph(c).is_some() => out.push(c),
            _ => out.push('?'),
        }
    }
    out
}

impl Canvas {
    /// Horizontal text; `y` is the centre of its line.
    pub(crate) fn text(&mut self, (x, y): (f64, f64), text: &str, align: Align, style: &TextStyle) {
        let text = printable(text);
        let start = start_of(x, text.chars().count(), align, style);
        let top = (y - style.height.val() as f64 / 2.0).round() as i64;
        for (i, c) in text.chars().enumerate() {
            let left = start + (i * style.glyph_width()) as i64;
            self.glyph(style, c, |gx, gy| (left + gx, top + gy));
        }
    }

    /// Text that reads upwards; `x` is the centre of its line.
    pub(crate) fn text_upwards(&mut self, (x, y): (f64, f64), text: &str, align: Align, style: &TextStyle) {
        let text = printable(text);
        let start = start_of(-y, text.chars().count(), align, style);
        let left = (x - style.height.val() as f64 / 2.0).round() as i64;
        for (i, c) in text.chars().enumerate() {
            let bottom = -(start + (i * style.glyph_width()) as i64);
            self.glyph(style, c, |gx, gy| (left + gy, bottom - gx));
        }
    }

    fn glyph(&mut self, style: &TextStyle, c: char, place: impl Fn(i64, i64) -> (i64, i64)) {
        let Some(glyph) = style.glyph(c) else { return };
        for (gy, row) in glyph.rows().enumerate() {
            for (gx, &coverage) in row.iter().enumerate() {
                if coverage > 0 {
                    let (px, py) = place(gx as i64, gy as i64);
                    self.blend(px, py, style.color, coverage);
                }
            }
        }
    }
}

fn start_of(at: f64, glyphs: usize, align: Align, style: &TextStyle) -> i64 {
    let width = (glyphs * style.glyph_width()) as f64;
    let shift = match align {
        Align::Start => 0.0,
        Align::Middle => width / 2.0,
        Align::End => width,
    };
    (at - shift).round() as i64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::PictureSize;

    fn style() -> TextStyle {
        TextStyle::new(RasterHeight::Size16, [0; 3])
    }

    #[test]
    fn characters_without_a_glyph_are_replaced() {
        assert_eq!(printable("\u{2212}1 \u{2026} \u{2265}2 m\u{b2}"), "-1 ... >=2 m\u{b2}");
        assert_eq!(printable("\u{1f600}\n"), "? ");
    }

    #[test]
    fn long_text_is_cut_to_the_width() {
        let s = style();
        let cut = s.fitted("a rather long dataset name", 10.0 * s.width_of("x"));
        assert_eq!(cut.chars().count(), 10);
        assert!(cut.ends_with("..."));
        assert_eq!(s.fitted("short", 1000.0), "short");
        assert_eq!(s.fitted("short", 0.0), "");
    }

    #[test]
    fn text_stays_in_its_box_and_upward_text_is_the_same_turned() {
        let s = style();
        let mut flat = Canvas::new(PictureSize::new(200, 200), [255; 3]);
        flat.text((100.0, 100.0), "Ag", Align::Start, &s);
        let flat = flat.into_picture();
        let mut up = Canvas::new(PictureSize::new(200, 200), [255; 3]);
        up.text_upwards((100.0, 100.0), "Ag", Align::Start, &s);
        let up = up.into_picture();
        let mut ink = 0;
        for y in 0..200 {
            for x in 0..200 {
                if flat[(x, y)] != [255; 3] {
                    ink += 1;
                    assert!((100..100 + s.width_of("Ag") as usize).contains(&x) && (92..108).contains(&y));
                    // Along the text: x - 100 steps right there, as many steps up here.
                    assert_eq!(up[(92 + (y - 92), 200 - x)], flat[(x, y)]);
                }
            }
        }
        assert!(ink > 30);
    }
}
