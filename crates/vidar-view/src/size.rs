//! How large a picture is, and how large its text and strokes are.

use noto_sans_mono_bitmap::RasterHeight;

/// Columns and rows of a picture, each within 160…8192.
///
/// Text and strokes grow with the picture in steps, so that a plot twice as large looks the same on a slide.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PictureSize {
    width: usize,
    height: usize,
}

impl PictureSize {
    /// Smallest side in pixels: below it axes do not fit.
    pub const MIN: usize = 160;
    /// Largest side in pixels: 8192² RGBA is 256 MiB, enough for a poster.
    pub const MAX: usize = 8192;

    /// The size, with each side brought into [`Self::MIN`]…[`Self::MAX`].
    pub fn new(width: usize, height: usize) -> Self {
        Self { width: width.clamp(Self::MIN, Self::MAX), height: height.clamp(Self::MIN, Self::MAX) }
    }

    /// Columns.
    pub fn width(self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(self) -> usize {
        self.height
    }

    /// Text heights and stroke unit that suit this size.
    pub(crate) fn type_scale(self) -> TypeScale {
        // Set by the limiting side: 16 px text suits 480 rows, and so on upwards.
        TypeScale::for_extent(self.width.min(self.height * 4 / 3))
    }
}

impl Default for PictureSize {
    /// 1200 × 900: a column of a paper at 300 dpi is about as wide.
    fn default() -> Self {
        Self::new(1200, 900)
    }
}

/// Text heights of one picture.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TypeScale {
    /// Tick labels, legends, axis titles.
    pub body: RasterHeight,
    /// The picture's title.
    pub title: RasterHeight,
    /// Width of a hair line, pixels; other strokes and gaps are multiples.
    pub unit: f64,
}

impl TypeScale {
    pub(crate) fn for_extent(extent: usize) -> Self {
        match extent {
            0..900 => Self { body: RasterHeight::Size16, title: RasterHeight::Size20, unit: 1.0 },
            900..1500 => Self { body: RasterHeight::Size20, title: RasterHeight::Size24, unit: 1.25 },
            1500..2200 => Self { body: RasterHeight::Size24, title: RasterHeight::Size32, unit: 1.5 },
            _ => Self { body: RasterHeight::Size32, title: RasterHeight::Size32, unit: 2.0 },
        }
    }

    /// Line height of body text, pixels.
    pub(crate) fn line(self) -> f64 {
        self.body.val() as f64
    }
}
