//! The text header of a PLY file.

use super::FORMAT;
use super::scalar::{Encoding, ScalarType};
use crate::error::{ExportError, quoted};

/// Most elements a header may declare. Files in the wild have two or three.
const MAX_ELEMENTS: usize = 64;
/// Most properties of one element. Gaussian-splat files, the widest in the wild, have about 62.
const MAX_PROPERTIES: usize = 1024;

pub(super) struct Header {
    pub encoding: Encoding,
    pub comments: Vec<String>,
    pub elements: Vec<Element>,
    /// Offset of the first byte after the header.
    pub body: usize,
}

pub(super) struct Element {
    pub name: String,
    pub count: usize,
    pub properties: Vec<Property>,
}

pub(super) struct Property {
    pub name: String,
    pub kind: PropertyKind,
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum PropertyKind {
    Scalar(ScalarType),
    List { count: ScalarType, item: ScalarType },
}

impl Property {
    /// The type of the value that is there even when a list is empty.
    pub fn least(&self) -> ScalarType {
        match self.kind {
            PropertyKind::Scalar(kind) => kind,
            PropertyKind::List { count, .. } => count,
        }
    }
}

pub(super) fn parse(file: &[u8]) -> Result<Header, ExportError> {
    let mut lines = HeaderLines { file, at: 0, number: 0 };
    let first = lines.next_line()?;
    if first != "ply" {
        return Err(lines.error("\"ply\"", quoted(&first)));
    }
    let mut encoding = None;
    let mut comments = Vec::new();
    let mut elements: Vec<Element> = Vec::new();
    loop {
        let line = lines.next_line()?;
        let (keyword, rest) = line.split_once(char::is_whitespace).unwrap_or((&line, ""));
        match keyword {
            "comment" => comments.push(rest.trim().to_owned()),
            "obj_info" | "" => {}
            "format" if encoding.is_none() => encoding = Some(parse_encoding(rest, &lines)?),
            "element" => {
                let element = parse_element(rest, &lines)?;
                if elements.len() == MAX_ELEMENTS || elements.iter().any(|e| e.name == element.name) {
                    let expected = format!("at most {MAX_ELEMENTS} elements of different names");
                    return Err(lines.error(&expected, quoted(&line)));
                }
                elements.push(element);
            }
            "property" => {
                let property = parse_property(rest, &lines)?;
                let Some(element) = elements.last_mut() else {
                    return Err(lines.error("an element before its property", quoted(&line)));
                };
                let known = element.properties.iter().any(|p| p.name == property.name);
                if known || element.properties.len() == MAX_PROPERTIES {
                    let expected = format!("at most {MAX_PROPERTIES} properties of different names");
                    return Err(lines.error(&expected, quoted(&line)));
                }
                element.properties.push(property);
            }
            "end_header" => break,
            _ => return Err(lines.error("a PLY header line", quoted(&line))),
        }
    }
    let encoding = encoding.ok_or_else(|| lines.error("a format line before it", "end_header"))?;
    Ok(Header { encoding, comments, elements, body: lines.at })
}

fn parse_encoding(rest: &str, lines: &HeaderLines<'_>) -> Result<Encoding, ExportError> {
    match rest.split_whitespace().collect::<Vec<_>>()[..] {
        ["ascii", "1.0"] => Ok(Encoding::Ascii),
        ["binary_little_endian", "1.0"] => Ok(Encoding::LittleEndian),
        ["binary_big_endian", "1.0"] => Ok(Encoding::BigEndian),
        _ => Err(lines.error("ascii, binary_little_endian or binary_big_endian, version 1.0", quoted(rest))),
    }
}

fn parse_element(rest: &str, lines: &HeaderLines<'_>) -> Result<Element, ExportError> {
    if let [name, count] = rest.split_whitespace().collect::<Vec<_>>()[..]
        && let Ok(count) = count.parse()
    {
        return Ok(Element { name: name.to_owned(), count, properties: Vec::new() });
    }
    Err(lines.error("an element's name and count", quoted(rest)))
}

fn parse_property(rest: &str, lines: &HeaderLines<'_>) -> Result<Property, ExportError> {
    let scalar =
        |name: &str| ScalarType::parse(name).ok_or_else(|| lines.error("a PLY scalar type", quoted(name)));
    match rest.split_whitespace().collect::<Vec<_>>()[..] {
        ["list", count, item, name] => {
            let (count, item) = (scalar(count)?, scalar(item)?);
            if !count.is_integer() {
                return Err(lines.error("an integer type for the length of a list", quoted(rest)));
            }
            Ok(Property { name: name.to_owned(), kind: PropertyKind::List { count, item } })
        }
        [kind, name] => Ok(Property { name: name.to_owned(), kind: PropertyKind::Scalar(scalar(kind)?) }),
        _ => Err(lines.error("a property's type and name", quoted(rest))),
    }
}

/// Header lines, ended by `\n` or `\r\n`; `at` is the byte after the last one.
struct HeaderLines<'a> {
    file: &'a [u8],
    at: usize,
    number: usize,
}

impl HeaderLines<'_> {
    fn next_line(&mut self) -> Result<String, ExportError> {
        self.number += 1;
        let rest = &self.file[self.at..];
        let Some(end) = rest.iter().position(|&b| b == b'\n') else {
            let found = if rest.is_empty() {
                "the end of the file".to_owned()
            } else {
                quoted(&String::from_utf8_lossy(&rest[..rest.len().min(200)]))
            };
            return Err(self.error("a header line", found));
        };
        self.at += end + 1;
        let line = rest[..end].strip_suffix(b"\r").unwrap_or(&rest[..end]);
        Ok(String::from_utf8_lossy(line).into_owned())
    }

    fn error(&self, expected: &str, found: impl Into<String>) -> ExportError {
        ExportError::malformed(FORMAT, format!("header line {}", self.number), expected, found)
    }
}
