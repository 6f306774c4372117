//! Text of unknown origin (names of files, values of headers) made safe to show: control characters, which terminals obey, and
//! characters that reverse the direction of what follows, are written as escapes.

use std::borrow::Cow;

/// Whether a terminal or a viewer would act on the character instead of showing it.
fn is_acted_on(c: char) -> bool {
    let reverses = matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    c.is_control() || reverses || matches!(c, '\u{2028}' | '\u{2029}')
}

/// The text in one line, every such character as `\u{1b}`, line breaks and tabs as `\n` and `\t`.
pub fn printable(text: &str) -> Cow<'_, str> {
    escaped(text, is_acted_on)
}

/// As [`printable`], line breaks and tabs kept: for text that a program laid out.
pub fn printable_lines(text: &str) -> Cow<'_, str> {
    escaped(text, |c| !matches!(c, '\n' | '\t') && is_acted_on(c))
}

fn escaped(text: &str, is_meant: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.chars().any(&is_meant) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        match is_meant(c) {
            true => shown.extend(c.escape_default()),
            false => shown.push(c),
        }
    }
    Cow::Owned(shown)
}

/// JSON text with the escapes of JSON in place of such characters; JSON itself only demands it for some. Line breaks between
/// values stay.
pub fn printable_json(json: &str) -> Cow<'_, str> {
    let is_meant = |c: char| c != '\n' && is_acted_on(c);
    if !json.chars().any(is_meant) {
        return Cow::Borrowed(json);
    }
    // Within JSON such characters occur in strings only; all of them are of 16 bits.
    let one = |c: char| if is_meant(c) { format!("\\u{:04x}", u32::from(c)) } else { c.to_string() };
    Cow::Owned(json.chars().map(one).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_terminal_obeys_is_escaped_and_letters_of_any_script_stay() {
        assert!(matches!(printable("Räume 測試 עברית"), Cow::Borrowed(_)));
        assert_eq!(printable("a\u{1b}[2Jb\u{9b}c\u{202e}d"), r"a\u{1b}[2Jb\u{9b}c\u{202e}d");
        assert_eq!(printable("one\ntwo\r"), r"one\ntwo\r");
        assert_eq!(printable_lines("one\n\ttwo\r"), "one\n\ttwo\\r");
        assert_eq!(printable_json("{\n \"a\": \"\u{9b}\"}"), "{\n \"a\": \"\\u009b\"}");
    }
}
