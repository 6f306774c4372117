//! The header of a safetensors file, checked key by key.

use std::collections::BTreeMap;
use std::fmt;
use std::ops::Range;

use half::{bf16, f16};
use safetensors::tensor::Dtype as FileDtype;
use serde::Deserialize;

/// The largest official header has 0.2 MB; the reference reader allows 100 MB, which would cost 1 GB to parse.
const MAX_HEADER_BYTES: usize = 16 << 20;
const METADATA_KEY: &str = "__metadata__";

/// A number format of a safetensors file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[allow(missing_docs)] // the names are the formats' own
pub enum Dtype {
    F64,
    F32,
    F16,
    Bf16,
    I64,
    I32,
    I16,
    I8,
    U64,
    U32,
    U16,
    U8,
    Bool,
}

impl Dtype {
    /// Bytes of one element.
    pub const fn size(self) -> usize {
        match self {
            Self::F64 | Self::I64 | Self::U64 => 8,
            Self::F32 | Self::I32 | Self::U32 => 4,
            Self::F16 | Self::Bf16 | Self::I16 | Self::U16 => 2,
            Self::I8 | Self::U8 | Self::Bool => 1,
        }
    }

    /// Decodes floating-point bytes into `out` (as many as fit both); false, and nothing done, for other formats.
    pub(crate) fn read_f32(self, bytes: &[u8], out: &mut [f32]) -> bool {
        match self {
            Self::F32 => {
                for (value, b) in out.iter_mut().zip(bytes.as_chunks().0) {
                    *value = f32::from_le_bytes(*b);
                }
            }
            Self::F16 => {
                for (value, b) in out.iter_mut().zip(bytes.as_chunks().0) {
                    *value = f16::from_le_bytes(*b).to_f32();
                }
            }
            Self::Bf16 => {
                for (value, b) in out.iter_mut().zip(bytes.as_chunks().0) {
                    *value = bf16::from_le_bytes(*b).to_f32();
                }
            }
            Self::F64 => {
                for (value, b) in out.iter_mut().zip(bytes.as_chunks().0) {
                    *value = f64::from_le_bytes(*b) as f32;
                }
            }
            _ => return false,
        }
        true
    }

    fn from_file(dtype: FileDtype) -> Option<Self> {
        Some(match dtype {
            FileDtype::F64 => Self::F64,
            FileDtype::F32 => Self::F32,
            FileDtype::F16 => Self::F16,
            FileDtype::BF16 => Self::Bf16,
            FileDtype::I64 => Self::I64,
            FileDtype::I32 => Self::I32,
            FileDtype::I16 => Self::I16,
            FileDtype::I8 => Self::I8,
            FileDtype::U64 => Self::U64,
            FileDtype::U32 => Self::U32,
            FileDtype::U16 => Self::U16,
            FileDtype::U8 => Self::U8,
            FileDtype::BOOL => Self::Bool,
            _ => return None,
        })
    }
}

impl fmt::Display for Dtype {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::F64 => "F64",
            Self::F32 => "F32",
            Self::F16 => "F16",
            Self::Bf16 => "BF16",
            Self::I64 => "I64",
            Self::I32 => "I32",
            Self::I16 => "I16",
            Self::I8 => "I8",
            Self::U64 => "U64",
            Self::U32 => "U32",
            Self::U16 => "U16",
            Self::U8 => "U8",
            Self::Bool => "BOOL",
        })
    }
}

/// Where one tensor lies; `range` counts from the start of the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Entry {
    pub(super) dtype: Dtype,
    pub(super) shape: Vec<usize>,
    pub(super) range: Range<usize>,
}

#[derive(Debug)]
pub(super) struct Header {
    pub(super) entries: BTreeMap<String, Entry>,
    pub(super) metadata: BTreeMap<String, String>,
}

/// A value of the header's object: tensors and the free text share it.
#[derive(Deserialize)]
#[serde(untagged)]
enum Item {
    Tensor { dtype: FileDtype, shape: Vec<usize>, data_offsets: (usize, usize) },
    Text(BTreeMap<String, String>),
}

/// Reads and checks the header; the error says what was found and what was expected.
pub(super) fn parse(file: &[u8]) -> Result<Header, String> {
    let Some((length, rest)) = file.split_first_chunk::<8>() else {
        return Err(format!("{} bytes, too short for the 8-byte header length", file.len()));
    };
    let length = usize::try_from(u64::from_le_bytes(*length)).unwrap_or(usize::MAX);
    if length > MAX_HEADER_BYTES {
        return Err(format!("header of {length} bytes, at most {MAX_HEADER_BYTES} are allowed"));
    }
    let Some((json, data)) = rest.split_at_checked(length) else {
        return Err(format!(
            "header of {length} bytes announced, the file ends after {} (truncated?)",
            rest.len()
        ));
    };
    let items: BTreeMap<String, Item> = serde_json::from_slice(json).map_err(|e| format!("header: {e}"))?;

    let mut entries = BTreeMap::new();
    let mut metadata = BTreeMap::new();
    let data_start = 8 + length;
    for (name, item) in items {
        match item {
            Item::Text(text) if name == METADATA_KEY => metadata = text,
            Item::Tensor { dtype, shape, data_offsets: (start, end) } if name != METADATA_KEY => {
                let dtype = Dtype::from_file(dtype)
                    .ok_or_else(|| format!("tensor {name:?} has dtype {dtype:?}, which is not supported"))?;
                if start > end || end > data.len() {
                    return Err(format!(
                        "tensor {name:?} lies at {start}..{end} of {} data bytes (truncated?)",
                        data.len()
                    ));
                }
                let size = shape.iter().try_fold(dtype.size(), |size, side| size.checked_mul(*side));
                if size != Some(end - start) {
                    return Err(format!(
                        "tensor {name:?}: {} bytes do not hold shape {shape:?} of {dtype}",
                        end - start
                    ));
                }
                entries.insert(name, Entry { dtype, shape, range: data_start + start..data_start + end });
            }
            _ => return Err(format!("entry {name:?} is neither a tensor nor text metadata")),
        }
    }
    check_tiling(&entries, data_start, file.len())?;
    Ok(Header { entries, metadata })
}

/// The ranges, in order, must cover the data section exactly.
fn check_tiling(entries: &BTreeMap<String, Entry>, data_start: usize, file_end: usize) -> Result<(), String> {
    let mut ranges: Vec<(&Range<usize>, &String)> =
        entries.iter().map(|(name, entry)| (&entry.range, name)).collect();
    ranges.sort_by_key(|(range, _)| (range.start, range.end));
    let mut at = data_start;
    for (range, name) in ranges {
        if range.start != at {
            let what =
                if range.start < at { "overlaps the tensor before it" } else { "leaves a hole before it" };
            return Err(format!("tensor {name:?} {what}: starts at byte {}, expected {at}", range.start));
        }
        at = range.end;
    }
    if at != file_end {
        return Err(format!("the tensors end at byte {at}, the file at {file_end}"));
    }
    Ok(())
}
