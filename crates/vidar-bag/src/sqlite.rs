//! Tables of an SQLite 3 file, read only (<https://www.sqlite.org/fileformat2.html>).
//!
//! Reads what ROS 2 bags need: rows of tables with a row id, overflow pages, and the pages of a write-ahead log that a
//! power loss left beside the file. There is no SQL, no index and no lock.

use crate::compression::MAX_DECOMPRESSED_BYTES;
use crate::error::BagError;
use crate::file::{BagFile, Window};
use std::collections::HashMap;
use std::path::Path;

pub(crate) const MAGIC: &[u8] = b"SQLite format 3\0";

const HEADER_BYTES: u64 = 100;
const INTERIOR_TABLE: u8 = 0x05;
const LEAF_TABLE: u8 = 0x0d;
/// Deepest tree: with two children a page, the largest file (2³² pages) has 32 levels.
const MAX_DEPTH: usize = 32;

/// Bytes read with the page of one row; the overflow pages of an image mostly follow each other.
const ROW_AHEAD_BYTES: u64 = 16 << 10;

/// An open database.
#[derive(Debug)]
pub(crate) struct Database {
    file: BagFile,
    page_bytes: u64,
    /// Bytes of a page that hold content.
    usable: u64,
    is_cut_off: bool,
    log: Option<Log>,
}

/// A write-ahead log: the newest committed version of some pages.
#[derive(Debug)]
struct Log {
    file: BagFile,
    /// Byte of the page's newest content.
    pages: HashMap<u32, u64>,
}

/// One value of a row.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Value {
    Null,
    Integer(i64),
    Real,
    Text(String),
    /// Where the bytes lie in the row.
    Blob(std::ops::Range<usize>),
}

impl Value {
    pub(crate) fn integer(&self) -> Option<i64> {
        if let Self::Integer(value) = self { Some(*value) } else { None }
    }

    pub(crate) fn text(&self) -> Option<&str> {
        if let Self::Text(text) = self { Some(text) } else { None }
    }
}

/// A table's root page and the names of its columns.
pub(crate) struct Table {
    pub root: u32,
    pub columns: Vec<String>,
}

impl Table {
    pub(crate) fn column(&self, name: &str) -> Option<usize> {
        self.columns.iter().position(|c| c == name)
    }
}

/// Where a row lies.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RowPlace {
    pub page: u32,
    pub cell: u16,
}

/// A row: its id and its bytes, whole or only those that its leaf page holds.
pub(crate) struct Row {
    pub id: i64,
    pub payload: Vec<u8>,
}

impl Database {
    pub(crate) fn open(file: BagFile) -> Result<Self, BagError> {
        let header = file.read(0, HEADER_BYTES)?;
        let malformed = |found: &str| file.malformed(16, found, "a page size of 512 to 65536 bytes");
        let page_bytes = match u16::from_be_bytes([header[16], header[17]]) {
            1 => 65536,
            size if size >= 512 && size.is_power_of_two() => u64::from(size),
            size => return Err(malformed(&format!("{size}"))),
        };
        let usable = page_bytes.saturating_sub(u64::from(header[20]));
        if usable < 480 {
            return Err(malformed(&format!("{usable} usable bytes a page")));
        }
        if !matches!(u32::from_be_bytes([header[56], header[57], header[58], header[59]]), 0 | 1) {
            return Err(file.unsupported("text in UTF-16", "ROS writes UTF-8"));
        }
        let mut name = file.path().as_os_str().to_owned();
        name.push("-wal");
        let log = Log::open(Path::new(&name), page_bytes)?;
        let stated = u64::from(be_u32(&header[28..]).unwrap_or(0));
        let is_cut_off = log.is_none() && stated > file.length() / page_bytes;
        Ok(Self { file, page_bytes, usable, log, is_cut_off })
    }

    /// Whether the file has fewer pages than it says.
    pub(crate) fn is_cut_off(&self) -> bool {
        self.is_cut_off
    }

    pub(crate) fn file(&self) -> &BagFile {
        &self.file
    }

    /// Pages that come from the write-ahead log.
    pub(crate) fn pages_from_log(&self) -> usize {
        self.log.as_ref().map_or(0, |l| l.pages.len())
    }

    /// A table by name.
    pub(crate) fn table(&self, name: &str) -> Result<Option<Table>, BagError> {
        let mut found = None;
        self.rows(1, &mut |_, row| {
            let Some(values) = values(&row.payload) else { return Ok(()) };
            let is_it = values.first().and_then(Value::text) == Some("table")
                && values.get(1).and_then(Value::text) == Some(name);
            if let (true, Some(root), Some(sql)) =
                (is_it, values.get(3).and_then(Value::integer), values.get(4).and_then(Value::text))
            {
                found = u32::try_from(root).ok().map(|root| Table { root, columns: columns(sql) });
            }
            Ok(())
        })?;
        Ok(found)
    }

    /// Visits every row of the table with this root, in the order of row ids; `row.payload` holds what its leaf page holds. Returns
    /// the number of pages that the file lacks.
    pub(crate) fn rows(
        &self,
        root: u32,
        visit: &mut dyn FnMut(RowPlace, &Row) -> Result<(), BagError>,
    ) -> Result<usize, BagError> {
        let mut stack = vec![(root, 0usize)];
        let mut window = Window::new(&self.file);
        // Each page has one place in one tree, so more visits than pages are a circle.
        let pages = self.file.length() / self.page_bytes + self.pages_from_log() as u64;
        let (mut visited, mut missing) = (0u64, 0);
        while let Some((number, depth)) = stack.pop() {
            visited += 1;
            if visited > pages + 1 || depth > MAX_DEPTH {
                return Err(self.malformed(number, "a tree of pages with a circle", "a tree"));
            }
            let Some(page) = self.page(&mut window, number)? else {
                missing += 1;
                continue;
            };
            let Some(tree) = TreePage::parse(&page, number) else {
                return Err(self.malformed(number, "no page of a table", "kind 5 or 13"));
            };
            if let Some(right) = tree.rightmost {
                stack.push((right, depth + 1));
                // The stack's order makes the leftmost child the next one.
                for cell in (0..tree.cells).rev() {
                    let child = tree.cell(&page, cell).and_then(be_u32);
                    stack.push((
                        child
                            .ok_or_else(|| self.malformed(number, "a cell outside of the page", "a child"))?,
                        depth + 1,
                    ));
                }
                continue;
            }
            for cell in 0..tree.cells {
                if let Some(cut) = tree.cell(&page, cell).and_then(|c| self.local(c)) {
                    let row = Row { id: cut.id, payload: cut.bytes.to_vec() };
                    visit(RowPlace { page: number, cell }, &row)?;
                }
            }
        }
        Ok(missing)
    }

    /// A whole row; `None` where its pages are missing.
    pub(crate) fn row(&self, place: RowPlace) -> Result<Option<Row>, BagError> {
        let mut window = Window::reading_ahead(&self.file, ROW_AHEAD_BYTES);
        let Some(page) = self.page(&mut window, place.page)? else { return Ok(None) };
        let Some(cut) = TreePage::parse(&page, place.page)
            .filter(|t| t.rightmost.is_none())
            .and_then(|t| t.cell(&page, place.cell))
            .and_then(|c| self.local(c))
        else {
            return Ok(None);
        };
        let held = self.file.length() + self.log.as_ref().map_or(0, |l| l.file.length());
        if cut.length > held || cut.length > MAX_DECOMPRESSED_BYTES {
            return Err(self.malformed(
                place.page,
                format!("a row of {} bytes", cut.length),
                "less than the file",
            ));
        }
        let mut payload = Vec::with_capacity(cut.length as usize);
        payload.extend_from_slice(cut.bytes);
        let mut next = cut.overflow;
        while let Some(number) = next.filter(|&n| n != 0) {
            let Some(page) = self.page(&mut window, number)? else { return Ok(None) };
            let rest = (cut.length - payload.len() as u64).min(self.usable - 4) as usize;
            if rest == 0 {
                break;
            }
            next = be_u32(&page);
            payload.extend_from_slice(page.get(4..4 + rest).unwrap_or_default());
        }
        let is_whole = payload.len() as u64 == cut.length;
        Ok(is_whole.then_some(Row { id: cut.id, payload }))
    }

    fn page(&self, window: &mut Window<'_>, number: u32) -> Result<Option<Vec<u8>>, BagError> {
        if let Some((log, &at)) = self.log.as_ref().and_then(|l| Some((l, l.pages.get(&number)?))) {
            return log.file.read(at, self.page_bytes).map(Some);
        }
        let Some(before) = u64::from(number).checked_sub(1) else { return Ok(None) };
        Ok(window.get(before * self.page_bytes, self.page_bytes)?.map(<[u8]>::to_vec))
    }

    /// The part of a leaf cell that lies on its page.
    fn local<'a>(&self, cell: &'a [u8]) -> Option<LocalRow<'a>> {
        let (length, after_length) = varint(cell)?;
        let (id, after_id) = varint(cell.get(after_length..)?)?;
        let length = u64::try_from(length).ok()?;
        let content = cell.get(after_length + after_id..)?;
        // Section 1.6 of the format, with U = usable bytes: X, M and K decide how much stays on the leaf page.
        let largest = self.usable - 35;
        if length <= largest {
            return Some(LocalRow { id, length, bytes: content.get(..length as usize)?, overflow: None });
        }
        let smallest = (self.usable - 12) * 32 / 255 - 23;
        let kept = smallest + (length - smallest) % (self.usable - 4);
        let kept = if kept <= largest { kept } else { smallest } as usize;
        Some(LocalRow {
            id,
            length,
            bytes: content.get(..kept)?,
            overflow: Some(be_u32(content.get(kept..)?)?),
        })
    }

    fn malformed(&self, page: u32, found: impl Into<String>, expected: &str) -> BagError {
        self.file.malformed(u64::from(page).saturating_sub(1) * self.page_bytes, found, expected)
    }
}

struct LocalRow<'a> {
    id: i64,
    length: u64,
    bytes: &'a [u8],
    overflow: Option<u32>,
}

/// Head of a page of a table's tree.
struct TreePage {
    cells: u16,
    /// Offset of the list of cells.
    list: usize,
    /// Last child of an interior page; `None` for a leaf.
    rightmost: Option<u32>,
}

impl TreePage {
    fn parse(page: &[u8], number: u32) -> Option<Self> {
        let at = if number == 1 { HEADER_BYTES as usize } else { 0 };
        let cells = u16::from_be_bytes(page.get(at + 3..at + 5)?.try_into().ok()?);
        match *page.get(at)? {
            LEAF_TABLE => Some(Self { cells, list: at + 8, rightmost: None }),
            INTERIOR_TABLE => {
                Some(Self { cells, list: at + 12, rightmost: Some(be_u32(page.get(at + 8..)?)?) })
            }
            _ => None,
        }
    }

    fn cell<'a>(&self, page: &'a [u8], index: u16) -> Option<&'a [u8]> {
        let at = self.list + 2 * usize::from(index);
        let offset = u16::from_be_bytes(page.get(at..at + 2)?.try_into().ok()?);
        page.get(usize::from(offset)..)
    }
}

impl Log {
    /// The committed pages of the log beside a database; `None` without one. A frame counts when its salts are those of the
    /// log's head, and only up to the last frame that ends a commit.
    fn open(path: &Path, page_bytes: u64) -> Result<Option<Self>, BagError> {
        if !path.is_file() {
            return Ok(None);
        }
        let file = BagFile::open(path)?;
        if file.length() < 32 {
            return Ok(None);
        }
        let head = file.read(0, 32)?;
        let is_log = matches!(be_u32(&head), Some(0x377f_0682 | 0x377f_0683));
        if !is_log || be_u32(&head[8..]).map(u64::from) != Some(page_bytes) {
            return Ok(None);
        }
        let (mut at, mut pages, mut pending) = (32u64, HashMap::new(), Vec::new());
        while at + 24 + page_bytes <= file.length() {
            let frame = file.read(at, 24)?;
            if frame[8..16] != head[16..24] {
                break;
            }
            if let (Some(number), Some(size)) = (be_u32(&frame), be_u32(&frame[4..])) {
                pending.push((number, at + 24));
                if size != 0 {
                    pages.extend(pending.drain(..));
                }
            }
            at += 24 + page_bytes;
        }
        Ok(Some(Self { file, pages }))
    }
}

fn be_u32(bytes: &[u8]) -> Option<u32> {
    bytes.first_chunk().map(|b| u32::from_be_bytes(*b))
}

/// A number of 1 to 9 bytes, and how many they are.
fn varint(bytes: &[u8]) -> Option<(i64, usize)> {
    let mut value = 0u64;
    for (index, &byte) in bytes.iter().take(9).enumerate() {
        if index == 8 {
            return Some((((value << 8) | u64::from(byte)) as i64, 9));
        }
        value = (value << 7) | u64::from(byte & 0x7f);
        if byte & 0x80 == 0 {
            return Some((value as i64, index + 1));
        }
    }
    None
}

/// The values of a row. Of a row that is cut, a blob's range may reach past what is there; the columns before it are whole.
pub(crate) fn values(payload: &[u8]) -> Option<Vec<Value>> {
    let (head_bytes, mut at) = varint(payload)?;
    let head_bytes = usize::try_from(head_bytes).ok()?;
    let mut body = head_bytes;
    let mut values = Vec::new();
    while at < head_bytes {
        let (kind, length) = varint(payload.get(at..)?)?;
        at += length;
        let size = match kind {
            0 | 8 | 9 => 0,
            1..=4 => kind as usize,
            5 => 6,
            6 | 7 => 8,
            n if n >= 12 => usize::try_from((n - 12) / 2).ok()?,
            _ => return None,
        };
        let end = body.checked_add(size)?;
        values.push(match kind {
            0 => Value::Null,
            8 | 9 => Value::Integer(kind - 8),
            7 => Value::Real,
            1..=6 => {
                let bytes = payload.get(body..end)?;
                let sign = if bytes.first()? & 0x80 == 0 { 0 } else { -1 };
                Value::Integer(bytes.iter().fold(sign, |value, &b| (value << 8) | i64::from(b)))
            }
            n if n % 2 == 0 => Value::Blob(body..end),
            _ => Value::Text(String::from_utf8_lossy(payload.get(body..end)?).into_owned()),
        });
        body = end;
    }
    Some(values)
}

/// Names of the columns in `CREATE TABLE name(a INTEGER, b TEXT, …)`.
fn columns(sql: &str) -> Vec<String> {
    let inside =
        sql.split_once('(').map_or("", |(_, rest)| rest.rsplit_once(')').map_or(rest, |(inside, _)| inside));
    let word = |c: &str| {
        c.split_ascii_whitespace()
            .next()
            .unwrap_or_default()
            .trim_matches(['"', '`', '[', ']'])
            .to_ascii_lowercase()
    };
    inside.split(',').map(word).collect()
}
