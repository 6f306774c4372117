//! H.265 through `rusty_h265`: parameter sets of `hvcC` (ISO/IEC 14496-15, 8.3.3), pictures in the order of output.

use crate::boxes::u16_at;
use crate::picture::{Colours, Picture, check_size, colours_of, round_to_eight};
use crate::unit::{Parameters, UnitDecoder};
use rusty_h265::{Error, Frame};

pub(crate) struct H265 {
    decoder: rusty_h265::Decoder,
    /// Bytes of a length before each part of a unit; `None` in a byte stream.
    length_size: Option<usize>,
    /// Highest temporal sub-layer: only its pictures can be left out without looking further.
    top_layer: u8,
    colours: Colours,
}

impl H265 {
    pub(crate) fn new(parameters: &Parameters) -> Result<Self, String> {
        let mut made = Self {
            decoder: rusty_h265::Decoder::new(),
            length_size: None,
            top_layer: 0,
            colours: colours_of(false, 0, 0),
        };
        let hvcc = match parameters {
            Parameters::Described(hvcc) => hvcc,
            Parameters::InStream(bytes) => {
                for nal in rusty_h265::nal::split_annex_b(bytes).iter().filter(|nal| nal.len() > 2) {
                    made.push(nal, None).map_err(|e| format!("parameter sets: {e}"))?;
                }
                return Ok(made);
            }
        };
        let cut = || "the description of the video (hvcC) is cut".to_string();
        made.length_size = Some(usize::from(hvcc.get(21).ok_or_else(cut)? & 3) + 1);
        let mut at = 23;
        for _ in 0..*hvcc.get(22).ok_or_else(cut)? {
            let count = u16_at(hvcc, at + 1).ok_or_else(cut)?;
            at += 3;
            for _ in 0..count {
                let length = usize::from(u16_at(hvcc, at).ok_or_else(cut)?);
                let nal = hvcc.get(at + 2..at + 2 + length).ok_or_else(cut)?;
                made.push(nal, None).map_err(|e| format!("parameter sets: {e}"))?;
                at += 2 + length;
            }
        }
        Ok(made)
    }

    /// Refuses a size before anything of it is allocated, and feeds a part of a unit.
    fn push(&mut self, nal: &[u8], unit: Option<i64>) -> Result<(), String> {
        if nal.first().map(|b| b >> 1 & 0x3f) == Some(SEQUENCE_PARAMETERS)
            && let Some(payload) = nal.get(2..)
            && let Ok(sps) = rusty_h265::ps::parse_sps(&rusty_h265::nal::unescape(payload).data)
        {
            check_size(u64::from(sps.width), u64::from(sps.height))?;
            self.top_layer = sps.max_sub_layers_minus1;
            let (is_full_range, matrix) =
                sps.vui.as_ref().map_or((false, 0), |v| (v.video_full_range_flag, v.matrix_coeffs));
            self.colours = colours_of(is_full_range, matrix, sps.height as usize);
        }
        self.decoder.push_nal(nal, unit).map_err(|e| e.to_string())
    }

    fn parts<'a>(&self, bytes: &'a [u8]) -> Vec<&'a [u8]> {
        let Some(size) = self.length_size else { return rusty_h265::nal::split_annex_b(bytes) };
        let (mut at, mut parts) = (0, Vec::new());
        while let Some(prefix) = bytes.get(at..at + size) {
            let length = prefix.iter().fold(0usize, |n, &b| n << 8 | usize::from(b));
            at += size;
            let Some(nal) = bytes.get(at..at.saturating_add(length)) else { break };
            at += length;
            parts.push(nal);
        }
        parts
    }
}

/// `nal_unit_type` of a sequence parameter set (ITU-T H.265, table 7-1).
const SEQUENCE_PARAMETERS: u8 = 33;

impl UnitDecoder for H265 {
    fn is_disposable(&self, bytes: &[u8]) -> bool {
        // Pictures of even types below 16 are no references within their sub-layer (7.4.2.2), and there is none above the top one.
        let is_free = |nal: &&[u8]| {
            let (kind, layer) =
                (nal.first().map_or(0xff, |b| b >> 1 & 0x3f), nal.get(1).map_or(0, |b| b & 7));
            kind < 16 && kind % 2 == 0 && layer == self.top_layer + 1
        };
        // Beside slices there may be delimiters, messages and filling.
        let is_beside = |nal: &&[u8]| nal.first().is_some_and(|b| matches!(b >> 1 & 0x3f, 35 | 38..=40));
        let parts = self.parts(bytes);
        parts.iter().any(is_free) && parts.iter().all(|n| is_free(n) || is_beside(n))
    }

    fn decode(&mut self, unit: usize, bytes: &[u8], is_last: bool) -> Result<Vec<(usize, Picture)>, String> {
        let mut first_error = None;
        for nal in self.parts(bytes) {
            // A header has two bytes; the decoder takes them for granted.
            if nal.len() > 2
                && let Err(e) = self.push(nal, Some(unit as i64))
            {
                first_error.get_or_insert(e);
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
                        pictures.push((number, picture(&frame, self.colours)?));
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

fn picture(frame: &Frame, colours: Colours) -> Result<Picture, String> {
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
    let picture =
        Picture { width: frame.width, height: frame.height, luma, chroma, chroma_shift: [1, 1], colours };
    if picture.is_whole() {
        Ok(picture)
    } else {
        Err("the decoder gave planes that do not fit its size".into())
    }
}

#[cfg(test)]
mod tests {
    use crate::{AccessUnits, StreamCodec, StreamUnit, VideoStream};
    use std::sync::Arc;
    use vidar_core::Timestamp;

    struct Units(Vec<Vec<u8>>);

    impl AccessUnits for Units {
        fn read(&self, number: usize) -> Result<Vec<u8>, String> {
            self.0.get(number).cloned().ok_or_else(|| "no such unit".into())
        }
    }

    /// Found by fuzzing: the vector instructions of `rusty_h265-accel` 0.6.2 (`fir_h_sse2_tail`) read up to eight bytes past the end of a
    /// plane. Without its feature `simd` both crates forbid unsafe code.
    #[test]
    fn the_decoder_is_built_without_unsafe_code_and_survives_what_was_found() {
        assert!(matches!(rusty_h265::accel::isa(), rusty_h265::accel::Isa::Scalar));
        let stream = include_bytes!("../tests/fixtures/end_of_plane.h265");
        let units = vec![stream.to_vec()];
        let sets = StreamCodec::H265.parameter_sets(stream);
        let listed = [StreamUnit { time: Timestamp::from_nanos(0), stands_alone: true }];
        let opened = VideoStream::open(StreamCodec::H265, &listed, sets, Arc::new(Units(units)));
        assert!(opened.is_ok_and(|stream| stream.size() == (96, 64)));
    }
}
