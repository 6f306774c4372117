//! Decoded pictures as RGB, upright.

use vidar_core::{FrameImage, Image};

/// A decoded picture: 8 bits, luma and two chroma planes.
#[derive(Clone, Debug)]
pub(crate) struct Picture {
    pub width: usize,
    pub height: usize,
    pub luma: Vec<u8>,
    pub chroma: [Vec<u8>; 2],
    /// Columns and rows of luma to one of chroma, as powers of two.
    pub chroma_shift: [u32; 2],
    pub colours: Colours,
}

/// How luma and chroma become red, green and blue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Colours {
    /// 0…255 instead of 16…235.
    pub is_full_range: bool,
    /// BT.709 instead of BT.601.
    pub is_bt709: bool,
}

impl Picture {
    /// Bytes in memory.
    pub(crate) fn bytes(&self) -> usize {
        self.luma.len() + self.chroma[0].len() + self.chroma[1].len()
    }

    /// Whether the planes hold what the size says.
    pub(crate) fn is_whole(&self) -> bool {
        let side = |length: usize, shift: u32| length >> shift;
        let chroma = side(self.width, self.chroma_shift[0]) * side(self.height, self.chroma_shift[1]);
        self.width > 0
            && self.height > 0
            && self.luma.len() == self.width * self.height
            && self.chroma.iter().all(|c| c.len() >= chroma && !c.is_empty())
    }

    /// Without the columns and rows that only fill the last macroblocks, where the stream forgot to say so: the container then
    /// states a size that is the decoded one before rounding up to 16.
    pub(crate) fn without_filling(self, (width, height): (usize, usize)) -> Self {
        let is_filled = |own: usize, stated: usize| stated > 0 && stated.next_multiple_of(16) == own;
        let same = (width, height) == (self.width, self.height);
        if same || !is_filled(self.width, width) || !is_filled(self.height, height) {
            return self;
        }
        let cut = |plane: &[u8], own: usize, columns: usize, rows: usize| -> Vec<u8> {
            plane.chunks_exact(own).take(rows).flat_map(|row| &row[..columns]).copied().collect()
        };
        let [x, y] = self.chroma_shift;
        let chroma = self.chroma.map(|c| cut(&c, self.width >> x, width >> x, height >> y));
        Self { luma: cut(&self.luma, self.width, width, height), chroma, width, height, ..self }
    }

    /// Red, green and blue, turned clockwise by quarter turns.
    pub(crate) fn upright(&self, quarter_turns: u8) -> FrameImage {
        let (w, h) = (self.width, self.height);
        let rows = Rows::new(self);
        FrameImage::Rgb8(match quarter_turns % 4 {
            0 => Image::from_fn(w, h, |x, y| rows.rgb(x, y)),
            1 => Image::from_fn(h, w, |x, y| rows.rgb(y, h - 1 - x)),
            2 => Image::from_fn(w, h, |x, y| rows.rgb(w - 1 - x, h - 1 - y)),
            _ => Image::from_fn(h, w, |x, y| rows.rgb(w - 1 - y, x)),
        })
    }
}

/// The conversion in whole numbers, 16 bits after the point, so that every machine gives the same bits.
struct Rows<'a> {
    picture: &'a Picture,
    chroma_width: usize,
    chroma_height: usize,
    black: i32,
    luma: i32,
    /// Red of Cr, green of Cb, green of Cr, blue of Cb.
    chroma: [i32; 4],
}

impl<'a> Rows<'a> {
    fn new(picture: &'a Picture) -> Self {
        // ITU-R BT.601 and BT.709: Kr and Kb; ranges of 219 and 224 steps.
        let (kr, kb) = if picture.colours.is_bt709 { (0.2126, 0.0722) } else { (0.299, 0.114) };
        let kg = 1.0 - kr - kb;
        let (black, luma, chroma) =
            if picture.colours.is_full_range { (0, 1.0, 1.0) } else { (16, 255.0 / 219.0, 255.0 / 224.0) };
        let fixed = |v: f64| (v * 65536.0).round() as i32;
        Self {
            picture,
            chroma_width: (picture.width >> picture.chroma_shift[0]).max(1),
            chroma_height: (picture.height >> picture.chroma_shift[1]).max(1),
            black,
            luma: fixed(luma),
            chroma: [
                fixed(2.0 * (1.0 - kr) * chroma),
                fixed(2.0 * (1.0 - kb) * kb / kg * chroma),
                fixed(2.0 * (1.0 - kr) * kr / kg * chroma),
                fixed(2.0 * (1.0 - kb) * chroma),
            ],
        }
    }

    fn rgb(&self, x: usize, y: usize) -> [u8; 3] {
        let p = self.picture;
        let u = (x >> p.chroma_shift[0]).min(self.chroma_width - 1);
        let v = (y >> p.chroma_shift[1]).min(self.chroma_height - 1);
        let at = v * self.chroma_width + u;
        let (cb, cr) = (i32::from(p.chroma[0][at]) - 128, i32::from(p.chroma[1][at]) - 128);
        let luma = (i32::from(p.luma[y * p.width + x]) - self.black) * self.luma + 32768;
        let [red, green_b, green_r, blue] = self.chroma;
        [luma + red * cr, luma - green_b * cb - green_r * cr, luma + blue * cb]
            .map(|c| (c >> 16).clamp(0, 255) as u8)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(luma: Vec<u8>, width: usize, colours: Colours) -> Picture {
        let height = luma.len() / width;
        let chroma = vec![128; (width / 2).max(1) * (height / 2).max(1)];
        Picture { width, height, luma, chroma: [chroma.clone(), chroma], chroma_shift: [1, 1], colours }
    }

    #[test]
    fn turns_are_clockwise() {
        let full = Colours { is_full_range: true, is_bt709: true };
        let p = picture((0..8).collect(), 4, full);
        let greys = |turns| match p.upright(turns) {
            FrameImage::Rgb8(i) => (i.width(), i.data().iter().map(|p| p[0]).collect::<Vec<_>>()),
            other => panic!("{other:?}"),
        };
        assert_eq!(greys(0), (4, vec![0, 1, 2, 3, 4, 5, 6, 7]));
        assert_eq!(greys(1), (2, vec![4, 0, 5, 1, 6, 2, 7, 3]));
        assert_eq!(greys(2), (4, vec![7, 6, 5, 4, 3, 2, 1, 0]));
        assert_eq!(greys(3), (2, vec![3, 7, 2, 6, 1, 5, 0, 4]));
    }

    #[test]
    fn filling_of_macroblocks_is_cut_only_where_the_container_says_so() {
        let full = Colours { is_full_range: true, is_bt709: true };
        let filled = || picture((0..32 * 16).map(|i| (i % 32) as u8).collect(), 32, full);
        let cut = filled().without_filling((22, 16));
        assert_eq!((cut.width, cut.height, cut.luma.len(), cut.chroma[0].len()), (22, 16, 22 * 16, 11 * 8));
        assert!(cut.is_whole() && cut.luma[22..44] == (0..22).collect::<Vec<u8>>());
        assert_eq!(filled().without_filling((11, 16)).width, 32);
        assert_eq!(filled().without_filling((0, 0)).width, 32);
    }

    #[test]
    fn limited_range_is_stretched() {
        let limited = Colours { is_full_range: false, is_bt709: false };
        match picture(vec![16, 235, 16, 235], 2, limited).upright(0) {
            FrameImage::Rgb8(i) => assert_eq!(i.data(), [[0; 3], [255; 3], [0; 3], [255; 3]]),
            other => panic!("{other:?}"),
        }
    }
}
