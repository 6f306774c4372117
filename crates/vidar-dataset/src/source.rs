//! Text files of unknown origin: bounded in size and line length, byte-order mark and CRLF detected.

use crate::error::{DatasetError, io_error};
use std::io::Read;
use std::path::Path;
use vidar_core::Warning;

/// Largest text file that is read as a whole: fifty minutes of 17 columns at 200 Hz.
pub const MAX_TEXT_BYTES: u64 = 192 << 20;
/// Largest text file that is read block by block: what [`MAX_ROWS`] lines of 17 columns take.
const MAX_BLOCKS_BYTES: u64 = 1 << 30;
/// Bytes of a block.
const BLOCK_BYTES: usize = 4 << 20;
/// Longest line that is read; the longest line of a known format (17 columns) has under 500 bytes.
pub const MAX_LINE_BYTES: usize = 16 << 10;

/// Reads a text file of at most [`MAX_TEXT_BYTES`].
pub(crate) fn read_text_file(path: &Path) -> Result<Vec<u8>, DatasetError> {
    read_file_up_to(path, MAX_TEXT_BYTES)
}

/// Reads a file of at most `limit` bytes; of a device or a pipe, which state no length, [`MAX_STREAM_BYTES`].
pub(crate) fn read_file_up_to(path: &Path, limit: u64) -> Result<Vec<u8>, DatasetError> {
    let file = std::fs::File::open(path).map_err(io_error(path))?;
    let metadata = file.metadata().map_err(io_error(path))?;
    let limit = if metadata.is_file() { limit } else { limit.min(MAX_STREAM_BYTES) };
    let too_large = |found| DatasetError::TooLarge { path: path.to_path_buf(), found, limit };
    if metadata.len() > limit {
        return Err(too_large(metadata.len()));
    }
    let mut bytes = Vec::with_capacity(metadata.len() as usize);
    file.take(limit + 1).read_to_end(&mut bytes).map_err(io_error(path))?;
    let found = bytes.len() as u64;
    if found > limit { Err(too_large(found)) } else { Ok(bytes) }
}

/// Largest input that is read from what is no file, bytes.
const MAX_STREAM_BYTES: u64 = 64 << 20;

/// Reads a text file block by block, each of whole lines, so that a long recording of an IMU is never in memory as text. `f` gets
/// the number of lines before the block.
pub(crate) fn for_each_block(
    path: &Path,
    mut f: impl FnMut(&Source<'_>, usize) -> Result<(), DatasetError>,
) -> Result<(), DatasetError> {
    let mut file = std::fs::File::open(path).map_err(io_error(path))?;
    let found = file.metadata().map_err(io_error(path))?.len();
    if found > MAX_BLOCKS_BYTES {
        let limit = MAX_BLOCKS_BYTES;
        return Err(DatasetError::TooLarge { path: path.to_path_buf(), found, limit });
    }
    let (mut block, mut lines_before) = (Vec::with_capacity(BLOCK_BYTES + MAX_LINE_BYTES), 0);
    loop {
        let kept = block.len();
        let limit = BLOCK_BYTES as u64;
        (&mut file).take(limit).read_to_end(&mut block).map_err(io_error(path))?;
        let is_end = block.len() == kept;
        // A line longer than is allowed ends the reading in `Source::lines`.
        let whole = match block.iter().rposition(|&b| b == b'\n') {
            Some(last) if !is_end && block.len() - last <= MAX_LINE_BYTES => last + 1,
            _ => block.len(),
        };
        f(&Source { path, bytes: &block[..whole] }, lines_before)?;
        if is_end {
            return Ok(());
        }
        lines_before += block[..whole].iter().filter(|&&b| b == b'\n').count();
        block.drain(..whole);
    }
}

/// Most rows of a file: 50 minutes at 1 kHz, four hours at 200 Hz. As IMU samples they take 170 MB.
pub const MAX_ROWS: usize = 3_000_000;

/// The bytes of a text file and its path for messages.
#[derive(Clone, Copy, Debug)]
pub struct Source<'a> {
    /// Where the bytes come from.
    pub path: &'a Path,
    /// The whole file.
    pub bytes: &'a [u8],
}

/// One line that is neither empty nor a comment.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Row<'a> {
    /// Counted from 1.
    pub line: usize,
    pub text: &'a str,
}

/// The rows and comments of a file.
pub(crate) struct Lines<'a> {
    pub rows: Vec<Row<'a>>,
    /// The first comments, without their `#`.
    pub comments: Vec<&'a str>,
}

/// Most comments that are kept; a header has a few lines, a file of comments may have millions.
const MAX_COMMENTS: usize = 32;

impl<'a> Source<'a> {
    /// An error about a line of this file.
    pub(crate) fn malformed(
        &self,
        line: usize,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> DatasetError {
        DatasetError::Malformed {
            path: self.path.to_path_buf(),
            line,
            found: found.into(),
            expected: expected.into(),
        }
    }

    /// The text without byte-order mark; UTF-16 is refused.
    fn without_bom(&self, notes: &mut Vec<Warning>) -> Result<&'a [u8], DatasetError> {
        match self.bytes {
            [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => {
                Err(self.malformed(1, "UTF-16 text (its byte-order mark)", "UTF-8 text"))
            }
            [0xef, 0xbb, 0xbf, rest @ ..] => {
                notes.push(
                    Warning::new(
                        "byte-order-mark",
                        "the file begins with a UTF-8 byte-order mark; it is skipped",
                    )
                    .at(self.path.display()),
                );
                Ok(rest)
            }
            all => Ok(all),
        }
    }

    /// The whole file as text.
    pub(crate) fn text(&self, notes: &mut Vec<Warning>) -> Result<&'a str, DatasetError> {
        let bytes = self.without_bom(notes)?;
        std::str::from_utf8(bytes).map_err(|e| {
            let line =
                1 + bytes.get(..e.valid_up_to()).unwrap_or_default().iter().filter(|&&b| b == b'\n').count();
            self.malformed(line, "bytes that are not UTF-8", "UTF-8 text")
        })
    }

    /// Splits the file into lines; skips empty ones and a first line of column names.
    pub(crate) fn lines(&self, notes: &mut Vec<Warning>) -> Result<Lines<'a>, DatasetError> {
        self.lines_after(0, notes)
    }

    /// The same of a block with `lines_before` lines before it.
    pub(crate) fn lines_after(
        &self,
        lines_before: usize,
        notes: &mut Vec<Warning>,
    ) -> Result<Lines<'a>, DatasetError> {
        let mut out = Lines { rows: Vec::new(), comments: Vec::new() };
        let mut crlf = false;
        for (index, raw) in self.without_bom(notes)?.split(|&b| b == b'\n').enumerate() {
            let line = lines_before + index + 1;
            if raw.len() > MAX_LINE_BYTES {
                let found = format!("a line of {} bytes", raw.len());
                return Err(self.malformed(line, found, format!("at most {MAX_LINE_BYTES} bytes a line")));
            }
            crlf |= raw.last() == Some(&b'\r');
            let text = std::str::from_utf8(raw)
                .map_err(|_| self.malformed(line, "bytes that are not UTF-8", "UTF-8 text"))?
                .trim();
            if let Some(comment) = text.strip_prefix('#') {
                if out.comments.len() < MAX_COMMENTS {
                    out.comments.push(comment.trim());
                }
            } else if lines_before == 0 && out.rows.is_empty() && is_column_names(text) {
                out.comments.push(text);
            } else if !text.is_empty() {
                if out.rows.len() == MAX_ROWS {
                    return Err(self.too_many_rows(line, MAX_ROWS));
                }
                out.rows.push(Row { line, text });
            }
        }
        if crlf {
            notes.push(
                Warning::new("crlf", "lines end with CRLF (Windows); read as usual").at(self.path.display()),
            );
        }
        Ok(out)
    }

    pub(crate) fn too_many_rows(&self, line: usize, limit: usize) -> DatasetError {
        self.malformed(line, format!("more than {limit} rows"), "a shorter file: split the recording")
    }

    /// A finite or non-finite number.
    pub(crate) fn number(&self, row: &Row<'_>, field: &str, what: &str) -> Result<f64, DatasetError> {
        field
            .parse::<f64>()
            .map_err(|_| self.malformed(row.line, quoted(field), format!("a number for {what}")))
    }
}

/// The first line of a csv without `#` may hold names of columns.
fn is_column_names(text: &str) -> bool {
    let mut fields = text.split([',', ' ', '\t', ';']).filter(|f| !f.is_empty());
    let first_is_word = fields.next().is_some_and(|f| f.starts_with(|c: char| c.is_ascii_alphabetic()));
    let known = ["time", "stamp", "nsec", "sec", "p_x", "tx"];
    let lower = text.to_ascii_lowercase();
    let names_images = lower.contains(".png") || lower.contains(".jp");
    // A row of words is names of columns whatever they are; "nan" is a number.
    let is_word = |f: &str| f.starts_with(|c: char| c.is_ascii_alphabetic()) && f.parse::<f64>().is_err();
    let words = text.split([',', '\t', ';']).map(str::trim);
    let all_words = words.clone().count() >= 4 && words.clone().all(is_word);
    first_is_word && !names_images && (all_words || known.iter().any(|k| lower.contains(k)))
}

/// A field as shown in a message: cut and with control characters escaped.
pub(crate) fn quoted(field: &str) -> String {
    format!("{:?}", field.chars().take(60).collect::<String>())
}

impl<'a> Row<'a> {
    /// Fields, separated by commas or semicolons where there are any, else by blanks.
    pub(crate) fn fields(&self) -> impl Iterator<Item = &'a str> {
        let separator = self.text.find([',', ';']);
        let (by_comma, by_blank) = match separator {
            Some(_) => (Some(self.text.trim_end_matches([',', ';']).split([',', ';'])), None),
            None => (None, Some(self.text.split_ascii_whitespace())),
        };
        by_comma.into_iter().flatten().map(str::trim).chain(by_blank.into_iter().flatten())
    }
}
