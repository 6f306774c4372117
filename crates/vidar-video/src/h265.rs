//! H.265 through `rusty_h265`: parameter sets of `hvcC` (ISO/IEC 14496-15, 8.3.3), pictures in the order of output.

use crate::boxes::u16_at;
use crate::picture::{Picture, check_size, colours_of, round_to_eight};
use rusty_h265::{Error, Frame};

pub(crate) struct H265 {
    decoder: rusty_h265::Decoder,
    length_size: usize,
}

impl H265 {
    pub(crate) fn new(hvcc: &[u8]) -> Result<Self, String> {
        let cut = || "the description of the video (hvcC) is cut".to_string();
        let length_size = usize::from(hvcc.get(21).ok_or_else(cut)? & 3) + 1;
        let mut decoder = rusty_h265::Decoder::new();
        let mut at = 23;
        for _ in 0..*hvcc.get(22).ok_or_else(cut)? {
            let count = u16_at(hvcc, at + 1).ok_or_else(cut)?;
            at += 3;
            for _ in 0..count {
                let length = usize::from(u16_at(hvcc, at).ok_or_else(cut)?);
                let nal = hvcc.get(at + 2..at + 2 + length).ok_or_else(cut)?;
                decoder.push_nal(nal, None).map_err(|e| format!("parameter sets: {e}"))?;
                at += 2 + length;
            }
        }
        Ok(Self { decoder, length_size })
    }

    /// Feeds a sample; gives the pictures whose turn in the order of display has come.
    pub(crate) fn decode(
        &mut self,
        sample: usize,
        bytes: &[u8],
        is_last: bool,
    ) -> Result<Vec<(usize, Picture)>, String> {
        let (mut at, mut first_error) = (0, None);
        while let Some(prefix) = bytes.get(at..at + self.length_size) {
            let length = prefix.iter().fold(0usize, |n, &b| n << 8 | usize::from(b));
            at += self.length_size;
            let Some(nal) = bytes.get(at..at.saturating_add(length)) else { break };
            at += length;
            // A header has two bytes; the decoder takes them for granted.
            if nal.len() > 2
                && let Err(e) = self.decoder.push_nal(nal, Some(sample as i64))
            {
                first_error.get_or_insert(e.to_string());
            }
        }
        if is_last {
            self.decoder.flush();
        }
        let mut pictures = Vec::new();
        loop {
            match self.decoder.next_frame() {
                Ok(frame) => {
                    if let Some(number) = frame.pts.and_then(|p| usize::try_from(p).ok()) {
                        pictures.push((number, picture(&frame)?));
                    }
                }
                Err(Error::Again | Error::Eof) => break,
                Err(e) => return Err(e.to_string()),
            }
        }
        match first_error {
            Some(reason) if pictures.is_empty() => Err(reason),
            _ => Ok(pictures),
        }
    }
}

fn picture(frame: &Frame) -> Result<Picture, String> {
    let p = &frame.picture;
    check_size(frame.width as u64, frame.height as u64)?;
    if p.chroma_format_idc != 1 {
        return Err(format!("chroma format {}; 4:2:0 is decoded", p.chroma_format_idc));
    }
    let (left, top, ..) = p.crop;
    let cut = |plane: usize, depth: u8, shift: usize| -> Option<Vec<u8>> {
        let plane = p.planes.get(plane)?;
        let (x, y, w, h) = (left >> shift, top >> shift, frame.width >> shift, frame.height >> shift);
        let mut out = Vec::with_capacity(w * h);
        for row in y..y + h {
            let start = row * plane.stride + x;
            out.extend(plane.data.get(start..start + w)?.iter().map(|&v| round_to_eight(v, depth)));
        }
        Some(out)
    };
    let planes = (|| {
        let luma = cut(0, p.bit_depth_luma, 0)?;
        Some((luma, [cut(1, p.bit_depth_chroma, 1)?, cut(2, p.bit_depth_chroma, 1)?]))
    })();
    let (luma, chroma) = planes.ok_or("the decoder gave planes that do not fit its size")?;
    let colours = colours_of(false, 0, frame.height);
    let picture =
        Picture { width: frame.width, height: frame.height, luma, chroma, chroma_shift: [1, 1], colours };
    if picture.is_whole() {
        Ok(picture)
    } else {
        Err("the decoder gave planes that do not fit its size".into())
    }
}
