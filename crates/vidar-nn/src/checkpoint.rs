//! Reading `model.safetensors` without copying it.
//!
//! The file is mapped; its header (a JSON object of name → dtype, shape, byte range) is checked entirely before any
//! tensor is handed out: the ranges must tile the data section without overlap or hole, each must have the size its shape
//! and dtype ask for, and the data section must end where the file ends. Nothing is allocated by sizes the file claims;
//! the header itself is limited to 16 MiB (official ones have 0.2 MB).

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::kernels::map::Mapping;
use crate::weight::Weight;

pub(crate) mod header;

pub use header::Dtype;
use header::Entry;

/// A checkpoint that cannot be read, or does not hold what was asked of it.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CheckpointError {
    /// The file cannot be opened or mapped.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's answer.
        source: std::io::Error,
    },
    /// The file is no valid safetensors file.
    #[error("{origin}: not a valid safetensors file: {what}")]
    Invalid {
        /// The file.
        origin: String,
        /// What was found and what was expected, with the tensor's name where there is one.
        what: String,
    },
    /// A tensor is not there.
    #[error("{origin}: tensor {name:?} is missing")]
    Missing {
        /// The file or other source of weights.
        origin: String,
        /// The key.
        name: String,
    },
    /// A tensor has another shape than the network needs.
    #[error("{origin}: tensor {name:?} has shape {found:?}, expected {expected:?}")]
    Shape {
        /// The file or other source of weights.
        origin: String,
        /// The key.
        name: String,
        /// The shape in the file.
        found: Vec<usize>,
        /// The shape of the network.
        expected: Vec<usize>,
    },
    /// A tensor has a number format that cannot be used there.
    #[error("{origin}: tensor {name:?} holds {found}, expected {expected}")]
    Type {
        /// The file or other source of weights.
        origin: String,
        /// The key.
        name: String,
        /// The format in the file.
        found: Dtype,
        /// The formats that would do.
        expected: &'static str,
    },
}

/// A mapped safetensors file. Cloning shares the mapping.
///
/// The file must not be truncated by others while it is in use: the system would end the process (`SIGBUS`), as for
/// every mapped file.
#[derive(Debug, Clone)]
pub struct Checkpoint {
    origin: Arc<str>,
    bytes: Arc<Mapping>,
    entries: Arc<BTreeMap<String, Entry>>,
    metadata: Arc<BTreeMap<String, String>>,
}

impl Checkpoint {
    /// Maps a file and checks its header.
    ///
    /// # Errors
    /// [`CheckpointError::Io`] and [`CheckpointError::Invalid`].
    pub fn open(path: &Path) -> Result<Self, CheckpointError> {
        let mapping =
            Mapping::open(path).map_err(|source| CheckpointError::Io { path: path.to_path_buf(), source })?;
        Self::from_mapping(mapping, &path.display().to_string())
    }

    /// Reads a file that is already in memory; `origin` names it in errors.
    ///
    /// # Errors
    /// [`CheckpointError::Invalid`].
    pub fn from_bytes(bytes: Vec<u8>, origin: &str) -> Result<Self, CheckpointError> {
        Self::from_mapping(Mapping::from(bytes), origin)
    }

    /// Reads a file that is part of the program, without copying it; `origin` names it in errors.
    ///
    /// # Errors
    /// [`CheckpointError::Invalid`].
    pub fn from_static(bytes: &'static [u8], origin: &str) -> Result<Self, CheckpointError> {
        Self::from_mapping(Mapping::Static(bytes), origin)
    }

    fn from_mapping(mapping: Mapping, origin: &str) -> Result<Self, CheckpointError> {
        let parsed = header::parse(mapping.bytes())
            .map_err(|what| CheckpointError::Invalid { origin: origin.to_owned(), what })?;
        Ok(Self {
            origin: origin.into(),
            bytes: Arc::new(mapping),
            entries: Arc::new(parsed.entries),
            metadata: Arc::new(parsed.metadata),
        })
    }

    /// The names of all tensors, sorted.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.entries.keys().map(String::as_str)
    }

    /// Whether there is a tensor of that name.
    pub fn contains(&self, name: &str) -> bool {
        self.entries.contains_key(name)
    }

    /// A tensor by its name.
    ///
    /// # Errors
    /// [`CheckpointError::Missing`].
    pub fn tensor(&self, name: &str) -> Result<TensorView<'_>, CheckpointError> {
        let (name, entry) = self.entry(name)?;
        Ok(TensorView {
            name,
            origin: &self.origin,
            dtype: entry.dtype,
            shape: &entry.shape,
            bytes: &self.bytes.bytes()[entry.range.clone()],
        })
    }

    /// The free text of the header (`__metadata__`): aliases of shared tensors, the program that wrote the file.
    pub fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// The name under which errors speak of this checkpoint (its path).
    pub fn origin(&self) -> &str {
        &self.origin
    }

    /// Size of the whole file in bytes.
    pub fn file_bytes(&self) -> usize {
        self.bytes.bytes().len()
    }

    fn entry(&self, name: &str) -> Result<(&str, &Entry), CheckpointError> {
        let found = self.entries.get_key_value(name).map(|(key, entry)| (key.as_str(), entry));
        found.ok_or_else(|| CheckpointError::Missing {
            origin: self.origin.to_string(),
            name: name.to_owned(),
        })
    }
}

/// One tensor of a [`Checkpoint`]: row-major, little-endian bytes inside the mapping.
#[derive(Debug, Clone, Copy)]
pub struct TensorView<'a> {
    /// Its key.
    pub name: &'a str,
    /// The checkpoint's name, for errors.
    pub origin: &'a str,
    /// Its number format.
    pub dtype: Dtype,
    /// Its shape, outermost first; empty for a scalar.
    pub shape: &'a [usize],
    /// Its bytes, `dtype.size() * product(shape)` of them, with no alignment promised.
    pub bytes: &'a [u8],
}

impl TensorView<'_> {
    /// Number of elements.
    pub fn len(&self) -> usize {
        self.bytes.len() / self.dtype.size()
    }

    /// Whether some side of the shape is zero.
    pub fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// The values of an `F32`, `F16`, `BF16` or `F64` tensor.
    ///
    /// # Errors
    /// [`CheckpointError::Type`] for integers.
    pub fn to_f32(&self) -> Result<Vec<f32>, CheckpointError> {
        let mut values = vec![0.0; self.len()];
        if self.dtype.read_f32(self.bytes, &mut values) {
            return Ok(values);
        }
        Err(self.wrong_type("F32, F16, BF16 or F64"))
    }

    /// The values of an `F64` or `F32` tensor.
    ///
    /// # Errors
    /// [`CheckpointError::Type`] otherwise.
    pub fn to_f64(&self) -> Result<Vec<f64>, CheckpointError> {
        match self.dtype {
            Dtype::F64 => Ok(self.bytes.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect()),
            Dtype::F32 => Ok(self.to_f32()?.into_iter().map(f64::from).collect()),
            _ => Err(self.wrong_type("F64 or F32")),
        }
    }

    /// The values of a `U8` or `BOOL` tensor.
    ///
    /// # Errors
    /// [`CheckpointError::Type`] otherwise.
    pub fn to_u8(&self) -> Result<Vec<u8>, CheckpointError> {
        match self.dtype {
            Dtype::U8 | Dtype::Bool => Ok(self.bytes.to_vec()),
            _ => Err(self.wrong_type("U8 or BOOL")),
        }
    }

    /// The values of a signed integer tensor (`I64`, `I32`, `I16`, `I8`) or of `U8`, `U16`, `U32`.
    ///
    /// # Errors
    /// [`CheckpointError::Type`] otherwise.
    pub fn to_i64(&self) -> Result<Vec<i64>, CheckpointError> {
        let bytes = self.bytes;
        Ok(match self.dtype {
            Dtype::I64 => bytes.as_chunks().0.iter().map(|b| i64::from_le_bytes(*b)).collect(),
            Dtype::I32 => bytes.as_chunks().0.iter().map(|b| i64::from(i32::from_le_bytes(*b))).collect(),
            Dtype::I16 => bytes.as_chunks().0.iter().map(|b| i64::from(i16::from_le_bytes(*b))).collect(),
            Dtype::I8 => bytes.iter().map(|b| i64::from(b.cast_signed())).collect(),
            Dtype::U8 => bytes.iter().map(|b| i64::from(*b)).collect(),
            Dtype::U16 => bytes.as_chunks().0.iter().map(|b| i64::from(u16::from_le_bytes(*b))).collect(),
            Dtype::U32 => bytes.as_chunks().0.iter().map(|b| i64::from(u32::from_le_bytes(*b))).collect(),
            _ => return Err(self.wrong_type("I64, I32, I16, I8, U8, U16 or U32")),
        })
    }

    fn wrong_type(&self, expected: &'static str) -> CheckpointError {
        CheckpointError::Type {
            origin: self.origin.to_owned(),
            name: self.name.to_owned(),
            found: self.dtype,
            expected,
        }
    }
}

/// Something that yields weights by key: a [`Checkpoint`], or weights made on the fly.
pub trait WeightSource: Send + Sync {
    /// The weight of that key, with exactly that shape.
    ///
    /// # Errors
    /// [`CheckpointError::Missing`], [`CheckpointError::Shape`] or [`CheckpointError::Type`].
    fn weight(&self, name: &str, shape: &[usize]) -> Result<Weight, CheckpointError>;

    /// Whether there is a weight of that key.
    fn has(&self, name: &str) -> bool;
}

impl WeightSource for Checkpoint {
    fn weight(&self, name: &str, shape: &[usize]) -> Result<Weight, CheckpointError> {
        let (_, entry) = self.entry(name)?;
        if entry.shape != shape {
            return Err(CheckpointError::Shape {
                origin: self.origin.to_string(),
                name: name.to_owned(),
                found: entry.shape.clone(),
                expected: shape.to_vec(),
            });
        }
        if !matches!(entry.dtype, Dtype::F32 | Dtype::F16 | Dtype::Bf16 | Dtype::F64) {
            return Err(self.tensor(name)?.wrong_type("F32, F16, BF16 or F64"));
        }
        let range: Range<usize> = entry.range.clone();
        Ok(Weight::mapped(name, shape, entry.dtype, Arc::clone(&self.bytes), range))
    }

    fn has(&self, name: &str) -> bool {
        self.contains(name)
    }
}

#[cfg(test)]
mod tests;
