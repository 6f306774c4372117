//! A little-endian cursor over untrusted bytes.

use crate::error::ExportError;

/// Reads values one after the other; every error names the byte.
pub(crate) struct Cursor<'a> {
    format: &'static str,
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Cursor<'a> {
    pub fn new(format: &'static str, bytes: &'a [u8]) -> Self {
        Self { format, bytes, at: 0 }
    }

    /// Bytes not read yet.
    pub fn remaining(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// An error at the byte that comes next.
    pub fn error(&self, what: &str, expected: impl Into<String>, found: impl Into<String>) -> ExportError {
        ExportError::malformed(self.format, format!("byte {} ({what})", self.at), expected, found)
    }

    /// The next `n` bytes.
    pub fn take(&mut self, n: usize, what: &str) -> Result<&'a [u8], ExportError> {
        match self.at.checked_add(n).and_then(|end| self.bytes.get(self.at..end)) {
            Some(taken) => {
                self.at += n;
                Ok(taken)
            }
            None => Err(self.error(what, format!("{n} more bytes"), format!("{} bytes", self.remaining()))),
        }
    }

    fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N], ExportError> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N, what)?);
        Ok(array)
    }

    pub fn u8(&mut self, what: &str) -> Result<u8, ExportError> {
        self.array::<1>(what).map(|[b]| b)
    }

    pub fn u32(&mut self, what: &str) -> Result<u32, ExportError> {
        self.array(what).map(u32::from_le_bytes)
    }

    pub fn i32(&mut self, what: &str) -> Result<i32, ExportError> {
        self.array(what).map(i32::from_le_bytes)
    }

    pub fn u64(&mut self, what: &str) -> Result<u64, ExportError> {
        self.array(what).map(u64::from_le_bytes)
    }

    /// A finite number.
    pub fn finite(&mut self, what: &str) -> Result<f64, ExportError> {
        let value = f64::from_le_bytes(self.array(what)?);
        if value.is_finite() {
            Ok(value)
        } else {
            Err(self.error(what, "a finite number before it", value.to_string()))
        }
    }

    /// A count of records of at least `least` bytes each, checked against the remaining bytes.
    pub fn count(&mut self, least: usize, what: &str) -> Result<usize, ExportError> {
        let count = self.u64(what)?;
        match usize::try_from(count).ok().filter(|&n| n.saturating_mul(least) <= self.remaining()) {
            Some(count) => Ok(count),
            None => {
                let found = format!("{count} of them before {} bytes", self.remaining());
                Err(self.error(
                    what,
                    format!("at most {} records of {least} bytes", self.remaining() / least),
                    found,
                ))
            }
        }
    }

    /// Text up to a zero byte.
    pub fn c_string(&mut self, what: &str) -> Result<&'a str, ExportError> {
        let rest = &self.bytes[self.at..];
        let Some(end) = rest.iter().position(|&b| b == 0) else {
            return Err(self.error(what, "a zero-ended text", "no zero byte"));
        };
        match std::str::from_utf8(&rest[..end]) {
            Ok(text) => {
                self.at += end + 1;
                Ok(text)
            }
            Err(error) => Err(self.error(what, "UTF-8 text", error.to_string())),
        }
    }

    /// Refuses bytes after the last record.
    pub fn end(&self) -> Result<(), ExportError> {
        match self.remaining() {
            0 => Ok(()),
            n => Err(self.error("after the last record", "the end of the file", format!("{n} more bytes"))),
        }
    }
}
