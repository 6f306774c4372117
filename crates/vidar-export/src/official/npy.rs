//! The npy format: a magic number, a Python dictionary, the values.

use crate::error::{ExportError, quoted};
use std::io::{self, Read, Write};

const FORMAT: &str = "npy";
const MAGIC: &[u8; 6] = b"\x93NUMPY";
/// numpy aligns values to this many bytes.
const ALIGNMENT: usize = 64;
/// Longest dictionary that is read; numpy writes about a hundred bytes.
const MOST_HEADER: usize = 10_000;
/// Most axes of an array; numpy's own limit.
const MOST_AXES: usize = 64;
/// Memory allocated at once while reading, bytes.
const PIECE: usize = 1 << 20;

/// The values of an array, in row-major order.
#[derive(Clone, Debug, PartialEq)]
pub enum NpyData {
    /// `uint8` (and `bool`).
    U8(Vec<u8>),
    /// `float32` (and `float16`).
    F32(Vec<f32>),
    /// `float64`.
    F64(Vec<f64>),
    /// `int64` and shorter integers.
    I64(Vec<i64>),
}

impl NpyData {
    /// How many values.
    pub fn len(&self) -> usize {
        match self {
            Self::U8(v) => v.len(),
            Self::F32(v) => v.len(),
            Self::F64(v) => v.len(),
            Self::I64(v) => v.len(),
        }
    }

    /// Memory of the values, bytes.
    pub fn bytes(&self) -> u64 {
        let width = match self {
            Self::U8(_) => 1,
            Self::F32(_) => 4,
            Self::F64(_) | Self::I64(_) => 8,
        };
        self.len() as u64 * width
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// An array with its shape.
#[derive(Clone, Debug, PartialEq)]
pub struct NpyArray {
    /// Length of each axis.
    pub shape: Vec<usize>,
    /// The values, the last axis fastest.
    pub data: NpyData,
}

impl NpyArray {
    /// An array whose shape and values agree.
    pub fn new(shape: Vec<usize>, data: NpyData) -> Result<Self, ExportError> {
        match count(&shape) {
            Some(n) if n == data.len() => Ok(Self { shape, data }),
            _ => {
                let reason = format!("{} values", data.len());
                Err(ExportError::unwritable(FORMAT, format!("an array of shape {shape:?}"), reason))
            }
        }
    }

    /// The values as 32-bit floats, whatever kind of float they are.
    pub fn into_f32(self) -> Option<Vec<f32>> {
        match self.data {
            NpyData::F32(values) => Some(values),
            NpyData::F64(values) => Some(values.into_iter().map(|v| v as f32).collect()),
            _ => None,
        }
    }

    /// Writes the array as version 1.0 of the format.
    pub fn write(&self, w: &mut dyn Write) -> io::Result<()> {
        let kind = match self.data {
            NpyData::U8(_) => "|u1",
            NpyData::F32(_) => "<f4",
            NpyData::F64(_) => "<f8",
            NpyData::I64(_) => "<i8",
        };
        let axes: Vec<String> = self.shape.iter().map(usize::to_string).collect();
        // A tuple of one needs its comma.
        let comma = if axes.len() == 1 { "," } else { "" };
        let shape = format!("({}{comma})", axes.join(", "));
        let mut header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}");
        let length = (MAGIC.len() + 4 + header.len() + 1).next_multiple_of(ALIGNMENT) - MAGIC.len() - 4;
        header.extend(std::iter::repeat_n(' ', length - header.len() - 1));
        header.push('\n');
        let length = u16::try_from(length).map_err(|_| io::Error::other("an array of too many axes"))?;
        w.write_all(MAGIC)?;
        w.write_all(&[1, 0])?;
        w.write_all(&length.to_le_bytes())?;
        w.write_all(header.as_bytes())?;
        match &self.data {
            NpyData::U8(values) => w.write_all(values),
            NpyData::F32(values) => write_values(w, values, |v| v.to_le_bytes()),
            NpyData::F64(values) => write_values(w, values, |v| v.to_le_bytes()),
            NpyData::I64(values) => write_values(w, values, |v| v.to_le_bytes()),
        }
    }

    /// Reads an array; `most_bytes` bounds its values.
    pub fn read(r: &mut dyn Read, place: &str, most_bytes: u64) -> Result<Self, ExportError> {
        let bad = |expected: &str, found: String| ExportError::malformed(FORMAT, place, expected, found);
        let mut start = [0; 8];
        read_exact(r, &mut start, place)?;
        if &start[..6] != MAGIC {
            return Err(bad("an array of numpy", format!("bytes {:02x?}", &start[..6])));
        }
        let length = match start[6] {
            1 => {
                let mut bytes = [0; 2];
                read_exact(r, &mut bytes, place)?;
                usize::from(u16::from_le_bytes(bytes))
            }
            2 | 3 => {
                let mut bytes = [0; 4];
                read_exact(r, &mut bytes, place)?;
                u32::from_le_bytes(bytes) as usize
            }
            other => return Err(bad("version 1, 2 or 3", other.to_string())),
        };
        if length > MOST_HEADER {
            return Err(bad("a header of some hundred bytes", format!("{length} bytes")));
        }
        let mut header = vec![0; length];
        read_exact(r, &mut header, place)?;
        let header = String::from_utf8_lossy(&header);
        let kind = parse_header(&header)
            .ok_or_else(|| bad("{'descr': …, 'fortran_order': …, 'shape': …}", quoted(header.trim_end())))?;
        if kind.fortran_order && kind.shape.len() > 1 {
            return Err(ExportError::Unsupported {
                format: FORMAT,
                place: place.to_owned(),
                feature: "column-major order".to_owned(),
                hint: "save numpy.ascontiguousarray(array)",
            });
        }
        let Some(size) = kind.size().filter(|size| size.decoded <= most_bytes) else {
            return Err(bad(
                &format!("at most {most_bytes} bytes of values"),
                format!("shape {:?}", kind.shape),
            ));
        };
        let raw = read_values(r, size.stored, place)?;
        let data = kind.decode(&raw).ok_or_else(|| ExportError::Unsupported {
            format: FORMAT,
            place: place.to_owned(),
            feature: format!("values of kind {}", quoted(&kind.descr)),
            hint: "save floats of 16 to 64 bits, integers, or booleans",
        })?;
        debug_assert_eq!(data.bytes(), size.decoded);
        Ok(Self { shape: kind.shape, data })
    }
}

fn write_values<T: Copy, const N: usize>(
    w: &mut dyn Write,
    values: &[T],
    bytes: impl Fn(T) -> [u8; N],
) -> io::Result<()> {
    let mut buffer = Vec::with_capacity(PIECE.min(values.len() * N));
    for chunk in values.chunks(PIECE / N) {
        buffer.clear();
        chunk.iter().for_each(|v| buffer.extend(bytes(*v)));
        w.write_all(&buffer)?;
    }
    Ok(())
}

fn read_exact(r: &mut dyn Read, buffer: &mut [u8], place: &str) -> Result<(), ExportError> {
    let wanted = buffer.len();
    r.read_exact(buffer).map_err(|e| broken(place, &format!("{wanted} more bytes"), &e))
}

fn broken(place: &str, expected: &str, error: &io::Error) -> ExportError {
    ExportError::malformed(FORMAT, place, expected, error.to_string())
}

/// Allocates memory as values are read, so that a wrong header cannot cause a large allocation.
fn read_values(r: &mut dyn Read, bytes: u64, place: &str) -> Result<Vec<u8>, ExportError> {
    let mut raw = Vec::with_capacity(PIECE.min(usize::try_from(bytes).unwrap_or(PIECE)));
    r.take(bytes).read_to_end(&mut raw).map_err(|e| broken(place, "values", &e))?;
    if raw.len() as u64 != bytes {
        let found = format!("{} bytes", raw.len());
        return Err(ExportError::malformed(FORMAT, place, format!("{bytes} bytes of values"), found));
    }
    let mut one_more = [0];
    match r.read(&mut one_more) {
        Ok(0) => Ok(raw),
        Ok(_) => Err(ExportError::malformed(FORMAT, place, "the end after the values", "more bytes")),
        Err(e) => Err(broken(place, "the end after the values", &e)),
    }
}

fn count(shape: &[usize]) -> Option<usize> {
    shape.iter().try_fold(1_usize, |n, axis| n.checked_mul(*axis))
}

/// Bytes of an array in the file and in memory.
struct Size {
    stored: u64,
    decoded: u64,
}

struct Kind {
    descr: String,
    fortran_order: bool,
    shape: Vec<usize>,
}

impl Kind {
    /// Size of the values; an unknown kind counts as bytes and is refused later, by name.
    fn size(&self) -> Option<Size> {
        let (stored, decoded) = match self.descr.trim_start_matches(['<', '|', '=']) {
            "f2" => (2, 4),
            "f4" => (4, 4),
            "f8" => (8, 8),
            "i1" => (1, 8),
            "i2" | "u2" => (2, 8),
            "i4" | "u4" => (4, 8),
            "i8" => (8, 8),
            _ => (1, 1),
        };
        let n = count(&self.shape)? as u64;
        Some(Size { stored: n.checked_mul(stored)?, decoded: n.checked_mul(decoded)? })
    }

    fn decode(&self, raw: &[u8]) -> Option<NpyData> {
        Some(match self.descr.trim_start_matches(['<', '|', '=']) {
            "u1" | "b1" => NpyData::U8(raw.to_vec()),
            "f2" => NpyData::F32(values(raw, |b: [u8; 2]| f32_from_half(u16::from_le_bytes(b)))),
            "f4" => NpyData::F32(values(raw, f32::from_le_bytes)),
            "f8" => NpyData::F64(values(raw, f64::from_le_bytes)),
            "i1" => NpyData::I64(values(raw, |b: [u8; 1]| i64::from(i8::from_le_bytes(b)))),
            "i2" => NpyData::I64(values(raw, |b: [u8; 2]| i64::from(i16::from_le_bytes(b)))),
            "u2" => NpyData::I64(values(raw, |b: [u8; 2]| i64::from(u16::from_le_bytes(b)))),
            "i4" => NpyData::I64(values(raw, |b: [u8; 4]| i64::from(i32::from_le_bytes(b)))),
            "u4" => NpyData::I64(values(raw, |b: [u8; 4]| i64::from(u32::from_le_bytes(b)))),
            "i8" => NpyData::I64(values(raw, i64::from_le_bytes)),
            _ => return None,
        })
    }
}

fn values<T, const N: usize>(raw: &[u8], value: impl Fn([u8; N]) -> T) -> Vec<T> {
    raw.as_chunks::<N>().0.iter().map(|bytes| value(*bytes)).collect()
}

/// IEEE 754 binary16.
fn f32_from_half(half: u16) -> f32 {
    let sign = u32::from(half >> 15) << 31;
    let (exponent, fraction) = (u32::from(half >> 10) & 31, u32::from(half) & 1023);
    match (exponent, fraction) {
        (0, 0) => f32::from_bits(sign),
        // Subnormal: fraction · 2^-24, exact in 32 bits.
        (0, _) => f32::from_bits(sign | (fraction as f32 * 2_f32.powi(-24)).to_bits()),
        (31, _) => f32::from_bits(sign | 0x7f80_0000 | (fraction << 13)),
        _ => f32::from_bits(sign | ((exponent + 112) << 23) | (fraction << 13)),
    }
}

/// Parses `{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }` apart.
fn parse_header(header: &str) -> Option<Kind> {
    let inner = header.trim().strip_prefix('{')?.strip_suffix('}')?;
    let after = |key: &str| {
        let rest = inner.split_once(&format!("'{key}'"))?.1;
        Some(rest.trim_start().strip_prefix(':')?.trim_start())
    };
    let descr = after("descr")?.strip_prefix('\'')?.split_once('\'')?.0.to_owned();
    let order = after("fortran_order")?;
    let fortran_order = match (order.starts_with("True"), order.starts_with("False")) {
        (true, _) => true,
        (_, true) => false,
        _ => return None,
    };
    let axes = after("shape")?.strip_prefix('(')?.split_once(')')?.0;
    let shape: Vec<usize> = axes
        .split(',')
        .map(str::trim)
        .filter(|axis| !axis.is_empty())
        .map(|axis| axis.trim_end_matches('L').parse().ok())
        .collect::<Option<_>>()?;
    (shape.len() <= MOST_AXES).then_some(Kind { descr, fortran_order, shape })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn round_trip(array: &NpyArray) -> NpyArray {
        let mut bytes = Vec::new();
        array.write(&mut bytes).unwrap();
        NpyArray::read(&mut bytes.as_slice(), "test", 1 << 20).unwrap()
    }

    #[test]
    fn arrays_of_every_kind_are_restored() {
        for (shape, data) in [
            (vec![2, 3], NpyData::F32(vec![1.0, -0.0, f32::MIN_POSITIVE, f32::INFINITY, 5.5, 6.25])),
            (vec![1], NpyData::F64(vec![0.1])),
            (vec![], NpyData::I64(vec![-7])),
            (vec![3, 0, 2], NpyData::U8(vec![])),
        ] {
            let array = NpyArray::new(shape, data).unwrap();
            assert_eq!(round_trip(&array), array);
        }
        assert!(NpyArray::new(vec![2, 2], NpyData::U8(vec![1])).is_err());
    }

    #[test]
    fn the_header_is_numpys_byte_for_byte() {
        let mut bytes = Vec::new();
        NpyArray::new(vec![2], NpyData::F32(vec![1.0, 2.0])).unwrap().write(&mut bytes).unwrap();
        // numpy.save of numpy.array([1, 2], numpy.float32), numpy 2.4.
        let header = b"\x93NUMPY\x01\x00v\x00{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }";
        assert_eq!(&bytes[..header.len()], header);
        assert_eq!(bytes.len(), 128 + 8);
        assert_eq!(bytes[127], b'\n');
    }

    #[test]
    fn halves_are_exact() {
        for (half, value) in [
            (0x3c00, 1.0),
            (0xc000, -2.0),
            (0x3555, 0.333_251_95),
            (0x0001, 5.960_464_5e-8),
            (0x7bff, 65504.0),
        ] {
            assert_eq!(f32_from_half(half), value);
        }
        assert!(f32_from_half(0x7e00).is_nan() && f32_from_half(0xfc00) == f32::NEG_INFINITY);
    }

    #[test]
    fn incomplete_and_too_large_arrays_are_refused_with_their_position() {
        let mut bytes = Vec::new();
        NpyArray::new(vec![3], NpyData::F32(vec![0.0; 3])).unwrap().write(&mut bytes).unwrap();
        let read = |bytes: &[u8], most: u64| NpyArray::read(&mut &bytes[..], "depth.npy", most);
        for n in 0..bytes.len() {
            assert!(read(&bytes[..n], 100).unwrap_err().to_string().contains("depth.npy"));
        }
        assert!(read(&[&bytes[..], b"x"].concat(), 100).is_err());
        assert!(read(&bytes, 11).unwrap_err().to_string().contains("at most 11 bytes"));
        let text = |kind: &str| {
            let header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': (1,), }}\n");
            [&b"\x93NUMPY\x01\x00"[..], &(header.len() as u16).to_le_bytes(), header.as_bytes(), b"abcd"]
                .concat()
        };
        assert!(read(&text("<f4"), 4).is_ok());
        assert!(read(&text(">f4"), 4).is_err(), "big-endian is not silently misread");
        assert!(read(&text("|O"), 4).is_err());
    }

    proptest! {
        #[test]
        fn no_bytes_panic(header in "[ -~]{0,80}", tail in proptest::collection::vec(any::<u8>(), 0..40)) {
            let length = (header.len() as u16).to_le_bytes();
            let bytes = [&b"\x93NUMPY\x01\x00"[..], &length, header.as_bytes(), &tail].concat();
            let _ = NpyArray::read(&mut bytes.as_slice(), "x", 1 << 16);
        }

        #[test]
        fn no_shape_panics(shape in proptest::collection::vec(any::<usize>(), 0..5)) {
            let axes: Vec<String> = shape.iter().map(usize::to_string).collect();
            let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({},)}}", axes.join(","));
            let length = (header.len() as u16).to_le_bytes();
            let bytes = [&b"\x93NUMPY\x01\x00"[..], &length, header.as_bytes(), &[0; 8]].concat();
            let _ = NpyArray::read(&mut bytes.as_slice(), "x", u64::MAX);
        }
    }
}
