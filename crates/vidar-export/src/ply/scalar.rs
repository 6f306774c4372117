//! The scalar types of PLY and the three encodings they come in.

use super::FORMAT;
use crate::error::{ExportError, quoted};

/// A scalar type of a PLY property.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ScalarType {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl ScalarType {
    pub fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Bytes of one value in a binary file.
    pub fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    pub fn is_integer(self) -> bool {
        !matches!(self, Self::F32 | Self::F64)
    }
}

/// How the body of a file is encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

/// Reads scalars one after the other from the body of a file.
pub(super) struct Body<'a> {
    encoding: Encoding,
    bytes: &'a [u8],
    at: usize,
    /// Offset of `bytes` in the file, for messages.
    offset: usize,
}

impl<'a> Body<'a> {
    pub fn new(encoding: Encoding, file: &'a [u8], offset: usize) -> Self {
        Self { encoding, bytes: &file[offset..], at: 0, offset }
    }

    /// Bytes not read yet.
    pub fn remaining(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// Fewest bytes that `count` values of these sizes take; saturating.
    pub fn least_bytes(&self, count: usize, types: impl Iterator<Item = ScalarType>) -> usize {
        let per_record: usize = match self.encoding {
            // A digit and what separates it from the next; the last separator may be missing.
            Encoding::Ascii => types.count() * 2,
            _ => types.map(ScalarType::size).sum(),
        };
        let total = count.saturating_mul(per_record);
        if self.encoding == Encoding::Ascii { total.saturating_sub(1) } else { total }
    }

    pub fn error(&self, context: &str, expected: &str, found: impl Into<String>) -> ExportError {
        ExportError::malformed(FORMAT, format!("byte {} ({context})", self.offset + self.at), expected, found)
    }

    /// The next value; integers up to 32 bits are exact in `f64`.
    #[inline]
    pub fn next(&mut self, kind: ScalarType, context: impl Fn() -> String) -> Result<f64, ExportError> {
        match self.encoding {
            Encoding::Ascii => self.next_ascii(kind, context),
            Encoding::LittleEndian => self.next_binary(kind, context, false),
            Encoding::BigEndian => self.next_binary(kind, context, true),
        }
    }

    #[inline]
    fn next_binary(
        &mut self,
        kind: ScalarType,
        context: impl Fn() -> String,
        reversed: bool,
    ) -> Result<f64, ExportError> {
        let size = kind.size();
        let Some(raw) = self.bytes.get(self.at..self.at + size) else {
            let found = format!("the end of the file after {} of them", self.remaining());
            return Err(self.error(&context(), &format!("{size} more bytes"), found));
        };
        self.at += size;
        let mut le = [0; 8];
        le[..size].copy_from_slice(raw);
        if reversed {
            le[..size].reverse();
        }
        let [a, b, c, d, ..] = le;
        Ok(match kind {
            ScalarType::I8 => f64::from(a as i8),
            ScalarType::U8 => f64::from(a),
            ScalarType::I16 => f64::from(i16::from_le_bytes([a, b])),
            ScalarType::U16 => f64::from(u16::from_le_bytes([a, b])),
            ScalarType::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            ScalarType::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            ScalarType::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            ScalarType::F64 => f64::from_le_bytes(le),
        })
    }

    fn next_ascii(&mut self, kind: ScalarType, context: impl Fn() -> String) -> Result<f64, ExportError> {
        self.skip_blanks();
        let rest = &self.bytes[self.at..];
        let end = rest.iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len());
        let token = &rest[..end];
        if token.is_empty() {
            return Err(self.error(&context(), "a number", "the end of the file"));
        }
        let text = std::str::from_utf8(token).ok();
        let value = text.and_then(|t| t.parse::<f64>().ok()).filter(|v| fits(kind, *v));
        match value {
            Some(value) => {
                self.at += end;
                Ok(value)
            }
            None => {
                let expected = format!("a number of type {kind:?}");
                Err(self.error(&context(), &expected, quoted(&String::from_utf8_lossy(token))))
            }
        }
    }

    /// Skips what may follow the last value of an ASCII file.
    pub fn skip_trailing_blanks(&mut self) {
        if self.encoding == Encoding::Ascii {
            self.skip_blanks();
        }
    }

    fn skip_blanks(&mut self) {
        let blanks = self.bytes[self.at..].iter().take_while(|b| b.is_ascii_whitespace()).count();
        self.at += blanks;
    }
}

/// Whether an ASCII value can be of its declared type (floats may be anything, also NaN).
fn fits(kind: ScalarType, value: f64) -> bool {
    let within = |low: f64, high: f64| value.fract() == 0.0 && (low..=high).contains(&value);
    match kind {
        ScalarType::I8 => within(-128.0, 127.0),
        ScalarType::U8 => within(0.0, 255.0),
        ScalarType::I16 => within(-32_768.0, 32_767.0),
        ScalarType::U16 => within(0.0, 65_535.0),
        ScalarType::I32 => within(f64::from(i32::MIN), f64::from(i32::MAX)),
        ScalarType::U32 => within(0.0, f64::from(u32::MAX)),
        ScalarType::F32 | ScalarType::F64 => true,
    }
}
