//! Lines and numbers of text formats, with the line number in every error.

use crate::error::{ExportError, quoted};
use std::fmt::Display;
use std::str::FromStr;

/// The lines of a text file, numbered from 1, without their ends (`\n` or `\r\n`).
pub(crate) struct Lines<'a> {
    pub format: &'static str,
    rest: std::str::Split<'a, char>,
    number: usize,
}

/// One line and its number.
#[derive(Clone, Copy)]
pub(crate) struct Line<'a> {
    pub format: &'static str,
    pub number: usize,
    pub text: &'a str,
}

impl<'a> Lines<'a> {
    /// Takes `bytes` as UTF-8 text.
    pub fn new(format: &'static str, bytes: &'a [u8]) -> Result<Self, ExportError> {
        let text = std::str::from_utf8(bytes).map_err(|error| {
            let at = error.valid_up_to();
            let line = bytes[..at].iter().filter(|&&b| b == b'\n').count() + 1;
            ExportError::malformed(
                format,
                format!("line {line} (byte {at})"),
                "UTF-8 text",
                format!("byte {:#04x}", bytes[at]),
            )
        })?;
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        Ok(Self { format, rest: text.split('\n'), number: 0 })
    }
}

impl<'a> Iterator for Lines<'a> {
    type Item = Line<'a>;

    fn next(&mut self) -> Option<Line<'a>> {
        let text = self.rest.next()?;
        self.number += 1;
        Some(Line { format: self.format, number: self.number, text: text.strip_suffix('\r').unwrap_or(text) })
    }
}

impl<'a> Line<'a> {
    /// The text after `#`, if the line is a comment.
    pub fn comment(&self) -> Option<&'a str> {
        self.text.trim_start().strip_prefix('#').map(str::trim)
    }

    /// Whether nothing but blanks is on the line.
    pub fn is_blank(&self) -> bool {
        self.text.trim().is_empty()
    }

    /// An error at this line.
    pub fn error(&self, expected: impl Display, found: impl Display) -> ExportError {
        ExportError::malformed(
            self.format,
            format!("line {}", self.number),
            expected.to_string(),
            found.to_string(),
        )
    }

    /// Exactly `N` columns separated by blanks, or by commas.
    pub fn columns<const N: usize>(&self, separator: Separator) -> Result<[&'a str; N], ExportError> {
        let mut columns = [""; N];
        let mut count = 0;
        let mut take = |column: &'a str| {
            if let Some(slot) = columns.get_mut(count) {
                *slot = column;
            }
            count += 1;
        };
        match separator {
            Separator::Blank => self.text.split_ascii_whitespace().for_each(&mut take),
            Separator::Comma => self.text.split(',').map(str::trim).for_each(&mut take),
        }
        if count == N {
            Ok(columns)
        } else {
            Err(self.error(format_args!("{N} columns"), format_args!("{count} in {}", quoted(self.text))))
        }
    }

    /// A number of any kind.
    pub fn number<T: FromStr>(&self, what: &str, token: &str) -> Result<T, ExportError> {
        token.parse().map_err(|_| self.error(what, quoted(token)))
    }

    /// A finite real number.
    pub fn finite(&self, what: &str, token: &str) -> Result<f64, ExportError> {
        let value: f64 = self.number(what, token)?;
        if value.is_finite() { Ok(value) } else { Err(self.error(what, quoted(token))) }
    }
}

/// The separator of columns in a line.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Separator {
    /// One or more blanks or tabs.
    Blank,
    /// One comma, blanks around it ignored.
    Comma,
}
