//! Decompression of chunks and messages, never to more bytes than announced or permitted.

use std::io::Read;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Largest decompressed chunk or message, bytes. Writers make chunks of 0.75 to 4 MiB; one 8K image of 16-bit colour has
/// 200 MB.
pub(crate) const MAX_DECOMPRESSED_BYTES: u64 = 512 << 20;

/// How a chunk is compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Compression {
    None,
    Lz4,
    Zstd,
    Bzip2,
}

impl Compression {
    /// By the name that ROS and MCAP write.
    pub(crate) fn from_name(name: &str) -> Option<Self> {
        match name {
            "" | "none" => Some(Self::None),
            "lz4" => Some(Self::Lz4),
            "zstd" => Some(Self::Zstd),
            "bz2" => Some(Self::Bzip2),
            _ => None,
        }
    }

    /// Decompresses to exactly `size` bytes, or to any number up to the limit where `size` is `None`. The output grows as it is
    /// produced, so a wrong `size` allocates nothing.
    pub(crate) fn decompress(self, packed: &[u8], size: Option<u64>) -> Result<Vec<u8>, String> {
        let limit = size.unwrap_or(MAX_DECOMPRESSED_BYTES);
        if limit > MAX_DECOMPRESSED_BYTES {
            return Err(format!("{limit} bytes decompressed; the limit is {MAX_DECOMPRESSED_BYTES}"));
        }
        // A panic of a decompressor costs the chunk, not the program; what it was doing is not used again.
        catch_unwind(AssertUnwindSafe(|| self.unpack(packed, size, limit)))
            .unwrap_or_else(|_| Err("the decompressor broke down on it".into()))
    }

    fn unpack(self, packed: &[u8], size: Option<u64>, limit: u64) -> Result<Vec<u8>, String> {
        let mut out = Vec::new();
        match self {
            Self::None => out.extend_from_slice(packed),
            Self::Lz4 => read_all(lz4_flex::frame::FrameDecoder::new(packed), limit, &mut out)?,
            Self::Bzip2 => read_all(bzip2::read::BzDecoder::new(packed), limit, &mut out)?,
            Self::Zstd => read_all(zstd_decoder(packed)?, limit, &mut out)?,
        }
        match size {
            Some(size) if out.len() as u64 != size => {
                Err(format!("{} bytes decompressed, {size} announced", out.len()))
            }
            _ => Ok(out),
        }
    }
}

/// The C library, or the decoder in Rust: the same bytes (decision 32).
#[cfg(feature = "native-zstd")]
fn zstd_decoder(packed: &[u8]) -> Result<impl Read + '_, String> {
    zstd::stream::read::Decoder::with_buffer(packed).map(|d| d.single_frame()).map_err(|e| e.to_string())
}

#[cfg(not(feature = "native-zstd"))]
fn zstd_decoder(packed: &[u8]) -> Result<impl Read + '_, String> {
    ruzstd::decoding::StreamingDecoder::new(packed).map_err(|e| e.to_string())
}

fn read_all(reader: impl Read, limit: u64, out: &mut Vec<u8>) -> Result<(), String> {
    reader.take(limit + 1).read_to_end(out).map_err(|e| e.to_string())?;
    if out.len() as u64 > limit {
        return Err(format!("more than {limit} bytes decompressed"));
    }
    Ok(())
}
