//! Access units through the decoders of H.264 and H.265.

use crate::picture::{Colours, Picture, check_size, colours_of, round_to_eight};
use crate::unit::{Parameters, UnitDecoder};
use rust_h264::nal::{NalUnit, NalUnitType, parse_annex_b, parse_avcc, parse_avcc_config, parse_sps_info};

/// The codec of a sequence, with the parameter sets that it begins with.
#[derive(Clone, Debug)]
pub(crate) enum Codec {
    H264(Parameters),
    #[cfg(feature = "h265")]
    H265(Parameters),
}

impl Codec {
    pub(crate) fn name(&self) -> &'static str {
        match self {
            Self::H264(_) => "H.264",
            #[cfg(feature = "h265")]
            Self::H265(_) => "H.265",
        }
    }

    /// Pictures that a decoder may hold back to bring them in order: 16 by the standard, of which only H.265's makes use.
    pub(crate) fn most_held_back(&self) -> usize {
        match self {
            Self::H264(_) => 0,
            #[cfg(feature = "h265")]
            Self::H265(_) => 17,
        }
    }

    /// A decoder at the beginning of a sequence.
    pub(crate) fn decoder(&self) -> Result<Box<dyn UnitDecoder>, String> {
        match self {
            Self::H264(parameters) => H264::new(parameters).map(|d| Box::new(d) as Box<dyn UnitDecoder>),
            #[cfg(feature = "h265")]
            Self::H265(parameters) => {
                crate::h265::H265::new(parameters).map(|d| Box::new(d) as Box<dyn UnitDecoder>)
            }
        }
    }
}

struct H264 {
    decoder: Box<rust_h264::decoder::Decoder>,
    /// Bytes of a length before each part of a unit; `None` in a byte stream.
    length_size: Option<usize>,
    colours: Colours,
}

impl H264 {
    fn new(parameters: &Parameters) -> Result<Self, String> {
        let decoder = Box::new(rust_h264::decoder::Decoder::new());
        let colours = Colours { is_full_range: false, is_bt709: false };
        let (length_size, parts) = match parameters {
            Parameters::Described(avcc) => {
                let config = parse_avcc_config(avcc).map_err(str::to_string)?;
                let sets = config.sps_nals.into_iter().chain(config.pps_nals);
                (Some(config.length_size), sets.collect())
            }
            Parameters::InStream(bytes) => (None, parse_annex_b(bytes)),
        };
        let mut made = Self { decoder, length_size, colours };
        for nal in &parts {
            made.take_size(nal).map_err(|e| format!("sequence parameters: {e}"))?;
            made.decoder.decode_nal(nal).map_err(|e| format!("parameter sets: {e}"))?;
        }
        Ok(made)
    }

    /// Refuses a size before anything of it is allocated.
    fn take_size(&mut self, nal: &NalUnit<'_>) -> Result<(), String> {
        if nal.nal_unit_type == NalUnitType::Sps {
            let info = parse_sps_info(nal).map_err(|e| e.to_string())?;
            check_size(u64::from(info.coded_width), u64::from(info.coded_height))?;
            self.colours = colours_of(info.full_range, info.matrix, info.height as usize);
        }
        Ok(())
    }

    fn parts<'a>(&self, bytes: &'a [u8]) -> Vec<NalUnit<'a>> {
        match self.length_size {
            Some(size) => parse_avcc(bytes, size),
            None => parse_annex_b(bytes),
        }
    }
}

impl UnitDecoder for H264 {
    fn is_disposable(&self, bytes: &[u8]) -> bool {
        // Only the head of each part counts, but the parts have to be found. Parameter sets and slices of reference pictures state
        // another `nal_ref_idc` (ITU-T H.264, 7.4.1).
        let parts = self.parts(bytes);
        parts.iter().any(|n| n.nal_unit_type == NalUnitType::Slice)
            && parts.iter().all(|n| n.nal_ref_idc == 0)
    }

    fn decode(&mut self, unit: usize, bytes: &[u8], _: bool) -> Result<Vec<(usize, Picture)>, String> {
        let mut first_error = None;
        for nal in self.parts(bytes) {
            match self.take_size(&nal) {
                Ok(()) => {}
                Err(reason) => return Err(reason),
            }
            if let Err(e) = self.decoder.decode_nal(&nal) {
                first_error.get_or_insert(e.to_string());
            }
        }
        // A unit is one picture, so nothing of it is still to come.
        match (self.decoder.flush(), first_error) {
            (Some(frame), _) => {
                let picture = h264_picture(frame, self.colours);
                if !picture.is_whole() {
                    return Err("the decoder gave planes that do not fit its size".into());
                }
                Ok(vec![(unit, picture)])
            }
            (None, Some(reason)) => Err(reason),
            (None, None) => Err("it holds no picture".into()),
        }
    }
}

fn h264_picture(frame: rust_h264::decoder::Frame, colours: Colours) -> Picture {
    let is_wide = frame.bytes_per_sample() == 2;
    let plane = |bytes: Vec<u8>| if is_wide { eight_bits(bytes) } else { bytes };
    let chroma_rows = match frame.chroma_format {
        rust_h264::decoder::ChromaFormat::Yuv420 => 1,
        rust_h264::decoder::ChromaFormat::Yuv422 => 0,
    };
    Picture {
        width: frame.width as usize,
        height: frame.height as usize,
        luma: plane(frame.y),
        chroma: [plane(frame.u), plane(frame.v)],
        chroma_shift: [1, chroma_rows],
        colours,
    }
}

/// Ten bits, little-endian, rounded to eight.
fn eight_bits(bytes: Vec<u8>) -> Vec<u8> {
    bytes.as_chunks::<2>().0.iter().map(|b| round_to_eight(u16::from_le_bytes(*b), 10)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bits of a parameter set (ITU-T H.264, 7.3.2.1 and 9.1).
    #[derive(Default)]
    struct Bits(Vec<bool>);

    impl Bits {
        fn fixed(&mut self, value: u32, count: u32) -> &mut Self {
            self.0.extend((0..count).rev().map(|i| value >> i & 1 == 1));
            self
        }

        fn golomb(&mut self, value: u32) -> &mut Self {
            let length = (value + 1).ilog2();
            self.fixed(0, length).fixed(value + 1, length + 1)
        }

        fn bytes(&self) -> Vec<u8> {
            let byte = |bits: &[bool]| (0..8).fold(0, |b, i| b << 1 | u8::from(bits.get(i) == Some(&true)));
            self.0.chunks(8).map(byte).collect()
        }
    }

    /// A byte stream of one sequence parameter set for pictures of these macroblocks.
    fn sequence(columns: u32, rows: u32) -> Vec<u8> {
        let mut bits = Bits::default();
        // Baseline, level 5.1, picture order of type 2, one reference, frames only.
        bits.fixed(66, 8).fixed(0, 8).fixed(51, 8).golomb(0).golomb(0).golomb(2).golomb(1).fixed(0, 1);
        bits.golomb(columns - 1).golomb(rows - 1).fixed(1, 1).fixed(1, 1).fixed(0, 1).fixed(0, 1).fixed(1, 1);
        [vec![0, 0, 0, 1, 0x67], bits.bytes()].concat()
    }

    #[test]
    fn a_size_beyond_any_camera_is_refused_before_a_picture_is_made() {
        let open = |stream| Codec::H264(Parameters::InStream(stream)).decoder().map(|_| ());
        assert_eq!(open(sequence(120, 68)), Ok(()));
        let refused = open(sequence(2000, 2000)).unwrap_err();
        assert!(refused.contains("32000x32000"), "{refused}");
        // Also in the middle of a sequence.
        let mut decoder = Codec::H264(Parameters::InStream(sequence(4, 4))).decoder().unwrap();
        let refused = decoder.decode(0, &sequence(2000, 2000), false).map(|_| ()).unwrap_err();
        assert!(refused.contains("32000x32000"), "{refused}");
    }
}
