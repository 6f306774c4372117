//! Text files of unknown origin: bounded in size, byte-order mark and CRLF found and named.

use crate::error::{DatasetError, io_error};
use std::io::Read;
use std::path::Path;

/// Largest text file that is read.
pub const MAX_TEXT_BYTES: u64 = 2 << 30;

/// Reads a text file of at most [`MAX_TEXT_BYTES`].
pub(crate) fn read_text_file(path: &Path) -> Result<Vec<u8>, DatasetError> {
    let file = std::fs::File::open(path).map_err(io_error(path))?;
    let found = file.metadata().map_err(io_error(path))?.len();
    if found > MAX_TEXT_BYTES {
        return Err(DatasetError::TooLarge { path: path.to_path_buf(), found, limit: MAX_TEXT_BYTES });
    }
    let mut bytes = Vec::with_capacity(found as usize);
    file.take(MAX_TEXT_BYTES).read_to_end(&mut bytes).map_err(io_error(path))?;
    Ok(bytes)
}
