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

/// Largest picture, pixels: 8K.
const MAX_PIXELS: u64 = 8192 * 4352;

/// Refuses pictures that would take more memory than any camera's.
pub(crate) fn check_size(width: u64, height: u64) -> Result<(), String> {
    if width.saturating_mul(height) > MAX_PIXELS {
        return Err(format!("pictures of {width}x{height} pixels; at most {MAX_PIXELS} pixels are decoded"));
    }
    Ok(())
}

/// Colours by the stream's own words (ITU-T H.273: matrix 1 is BT.709, 5 and 6 BT.601); without them by size, as players do.
pub(crate) fn colours_of(is_full_range: bool, matrix: u8, height: usize) -> Colours {
    let is_bt709 = match matrix {
        1 => true,
        5 | 6 => false,
        _ => height >= 720,
    };
    Colours { is_full_range, is_bt709 }
}

/// A sample of `depth` bits as eight.
pub(crate) fn round_to_eight(value: u16, depth: u8) -> u8 {
    let drop = u32::from(depth.saturating_sub(8));
    if drop == 0 {
        return value.min(255) as u8;
    }
    ((u32::from(value) + (1 << (drop - 1))) >> drop).min(255) as u8
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
        let steps = Steps::new(self.colours);
        let chroma_width = (w >> self.chroma_shift[0]).max(1);
        let chroma_rows = (h >> self.chroma_shift[1]).max(1);
        let mut pixels = vec![[0; 3]; w * h];
        for (y, (out, luma)) in pixels.chunks_exact_mut(w).zip(self.luma.chunks_exact(w)).enumerate() {
            let at = (y >> self.chroma_shift[1]).min(chroma_rows - 1) * chroma_width;
            let [cb, cr] = [0, 1].map(|c| &self.chroma[c][at..at + chroma_width]);
            steps.row(out, luma, cb, cr, self.chroma_shift[0]);
        }
        let at = |x: usize, y: usize| pixels[y * w + x];
        let made = match quarter_turns % 4 {
            1 => Ok(Image::from_fn(h, w, |x, y| at(y, h - 1 - x))),
            2 => Ok(Image::from_fn(w, h, |x, y| at(w - 1 - x, h - 1 - y))),
            3 => Ok(Image::from_fn(h, w, |x, y| at(w - 1 - y, x))),
            _ => Image::from_vec(w, h, pixels),
        };
        // `w * h` pixels were made above.
        FrameImage::Rgb8(made.unwrap_or_else(|_| Image::filled(w, h, [0; 3])))
    }
}

/// The conversion in whole numbers, 16 bits after the point, so that every machine gives the same bits.
struct Steps {
    black: i32,
    luma: i32,
    red_of_cr: i32,
    green_of_cb: i32,
    green_of_cr: i32,
    blue_of_cb: i32,
}

impl Steps {
    fn new(colours: Colours) -> Self {
        // ITU-R BT.601 and BT.709: Kr and Kb; ranges of 219 and 224 steps.
        let (kr, kb) = if colours.is_bt709 { (0.2126, 0.0722) } else { (0.299, 0.114) };
        let kg = 1.0 - kr - kb;
        let (black, luma, chroma) =
            if colours.is_full_range { (0, 1.0, 1.0) } else { (16, 255.0 / 219.0, 255.0 / 224.0) };
        let fixed = |v: f64| (v * 65536.0).round() as i32;
        Self {
            black,
            luma: fixed(luma),
            red_of_cr: fixed(2.0 * (1.0 - kr) * chroma),
            green_of_cb: fixed(2.0 * (1.0 - kb) * kb / kg * chroma),
            green_of_cr: fixed(2.0 * (1.0 - kr) * kr / kg * chroma),
            blue_of_cb: fixed(2.0 * (1.0 - kb) * chroma),
        }
    }

    /// A row of pixels; a sample of chroma is for `1 << shift` columns, the last also for an odd one.
    fn row(&self, out: &mut [[u8; 3]], luma: &[u8], cb: &[u8], cr: &[u8], shift: u32) {
        let whole = cb.len() << shift;
        let pairs = out.chunks_mut(1 << shift).zip(luma.chunks(1 << shift)).zip(cb.iter().zip(cr));
        for ((out, luma), (&cb, &cr)) in pairs {
            let shares = self.shares(cb, cr);
            out.iter_mut().zip(luma).for_each(|(pixel, &luma)| *pixel = self.rgb(luma, shares));
        }
        if let (Some(&cb), Some(&cr), Some(out), Some(luma)) =
            (cb.last(), cr.last(), out.get_mut(whole..), luma.get(whole..))
        {
            let shares = self.shares(cb, cr);
            out.iter_mut().zip(luma).for_each(|(pixel, &luma)| *pixel = self.rgb(luma, shares));
        }
    }

    /// What chroma adds to red, green and blue.
    #[inline]
    fn shares(&self, cb: u8, cr: u8) -> [i32; 3] {
        let (cb, cr) = (i32::from(cb) - 128, i32::from(cr) - 128);
        [self.red_of_cr * cr, -self.green_of_cb * cb - self.green_of_cr * cr, self.blue_of_cb * cb]
    }

    #[inline]
    fn rgb(&self, luma: u8, shares: [i32; 3]) -> [u8; 3] {
        let luma = (i32::from(luma) - self.black) * self.luma + 32768;
        shares.map(|share| ((luma + share) >> 16).clamp(0, 255) as u8)
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
