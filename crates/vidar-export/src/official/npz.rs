//! Several arrays in one zip, as `numpy.savez_compressed` writes them and `numpy.load` reads them.

use super::npy::NpyArray;
use crate::error::{ExportError, write_error};
use std::collections::BTreeMap;
use std::io::{BufWriter, Read, Seek, Write};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

const FORMAT: &str = "npz";

/// Limits on the decompressed size of a file. Deflate can expand a file a thousandfold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NpzLimits {
    /// Most bytes of values, all arrays together.
    pub bytes: u64,
    /// Most arrays.
    pub arrays: usize,
}

impl Default for NpzLimits {
    /// 16 GiB, about ten thousand views at 504×378.
    fn default() -> Self {
        Self { bytes: 16 << 30, arrays: 4096 }
    }
}

/// Whether arrays are compressed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Packing {
    /// As `numpy.savez_compressed`.
    #[default]
    Deflated,
    /// As `numpy.savez`: larger, limited by the disk's speed only.
    Stored,
}

/// Writes arrays in the order given, each deflated under its name.
pub fn write_npz_arrays<W: Write + Seek>(w: W, arrays: &[(&str, &NpyArray)]) -> Result<(), ExportError> {
    write_npz_arrays_with(w, arrays, Packing::Deflated)
}

/// Writes arrays in the order given, each under its name.
pub fn write_npz_arrays_with<W: Write + Seek>(
    w: W,
    arrays: &[(&str, &NpyArray)],
    packing: Packing,
) -> Result<(), ExportError> {
    let failed =
        |e: zip::result::ZipError| ExportError::Write { format: FORMAT, source: std::io::Error::other(e) };
    let mut archive = ZipWriter::new(w);
    for (name, array) in arrays {
        let method = match packing {
            Packing::Deflated => CompressionMethod::Deflated,
            Packing::Stored => CompressionMethod::Stored,
        };
        let options = SimpleFileOptions::default()
            .compression_method(method)
            // numpy does the same; only entries beyond 4 GiB need it.
            .large_file(array.data.bytes() > u64::from(u32::MAX) / 2);
        archive.start_file(format!("{name}.npy"), options).map_err(failed)?;
        let mut buffered = BufWriter::with_capacity(1 << 16, &mut archive);
        array.write(&mut buffered).and_then(|()| buffered.flush()).map_err(write_error(FORMAT))?;
    }
    archive.finish().map_err(failed)?.flush().map_err(write_error(FORMAT))
}

/// Reads every array of a file, by name without `.npy`.
pub fn read_npz<R: Read + Seek>(r: R, limits: NpzLimits) -> Result<BTreeMap<String, NpyArray>, ExportError> {
    let bad =
        |place: &str, found: String| ExportError::malformed(FORMAT, place, "a zip of numpy arrays", found);
    let mut archive = ZipArchive::new(r).map_err(|e| bad("whole file", e.to_string()))?;
    if archive.len() > limits.arrays {
        return Err(bad("whole file", format!("{} entries, more than {}", archive.len(), limits.arrays)));
    }
    let mut left = limits.bytes;
    let mut arrays = BTreeMap::new();
    for index in 0..archive.len() {
        let place = format!("entry {index}");
        let mut entry = archive.by_index(index).map_err(|e| bad(&place, e.to_string()))?;
        let name = entry.name().map_err(|e| bad(&place, e.to_string()))?.into_owned();
        let Some(key) = name.strip_suffix(".npy").map(str::to_owned) else {
            return Err(bad(&place, format!("an entry called {}", crate::error::quoted(&name))));
        };
        let array = NpyArray::read(&mut entry, &format!("{place}, {}", crate::error::quoted(&key)), left)?;
        left = left.saturating_sub(array.data.bytes());
        if arrays.insert(key, array).is_some() {
            return Err(bad(&place, format!("a second {}", crate::error::quoted(&name))));
        }
    }
    Ok(arrays)
}
