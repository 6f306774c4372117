//! Accessors: typed views of the binary chunk, checked before use.

use super::json::{Accessor, Document};
use super::{FLOAT, FORMAT, UNSIGNED_BYTE, UNSIGNED_INT, UNSIGNED_SHORT, srgb_from_linear};
use crate::error::{ExportError, quoted};

/// Largest distance between elements that glTF allows, bytes.
const MAX_STRIDE: usize = 252;

/// The accessors of a file, with a budget of elements to read.
pub(super) struct Accessors<'a> {
    document: &'a Document,
    binary: &'a [u8],
    /// Elements that may still be read; repeated data counts each time.
    budget: usize,
}

/// The elements of one accessor, all within the file.
struct Elements<'a> {
    accessor: &'a Accessor,
    component_bytes: usize,
    element_bytes: usize,
    stride: usize,
    data: &'a [u8],
}

impl<'a> Elements<'a> {
    fn iter(&self) -> impl Iterator<Item = &'a [u8]> + use<'a> {
        let element_bytes = self.element_bytes;
        self.data.chunks(self.stride).map(move |chunk| &chunk[..element_bytes])
    }
}

impl<'a> Accessors<'a> {
    pub fn new(document: &'a Document, binary: &'a [u8], budget: usize) -> Self {
        Self { document, binary, budget }
    }

    /// An accessor of floats: SCALAR for `N = 1`, VEC3 for `N = 3`.
    pub fn reals<const N: usize>(&mut self, index: usize, place: &str) -> Result<Vec<[f64; N]>, ExportError> {
        let kind = if N == 1 { "SCALAR" } else { "VEC3" };
        let elements = self.elements(index, &[(kind, N)], place)?;
        if elements.accessor.component_type != FLOAT {
            let feature = format!("component type {} here", elements.accessor.component_type);
            return Err(unsupported(place, feature));
        }
        let read = |bytes: &[u8]| {
            let mut values = [0.0; N];
            for (value, b) in values.iter_mut().zip(bytes.chunks_exact(4)) {
                *value = f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
            }
            values
        };
        Ok(elements.iter().map(read).collect())
    }

    /// Linear colours as sRGB bytes; alpha is left out.
    pub fn colors(&mut self, index: usize, place: &str) -> Result<Vec<[u8; 3]>, ExportError> {
        let elements = self.elements(index, &[("VEC3", 3), ("VEC4", 4)], place)?;
        let Elements { accessor, component_bytes, .. } = elements;
        let component = accessor.component_type;
        if component == UNSIGNED_INT || (component != FLOAT && !accessor.normalized) {
            let expected = "COLOR_0 of float or normalised integers";
            return Err(bad(place, expected, format!("component type {component}")));
        }
        let linear = |b: &[u8]| match *b {
            [v] => f64::from(v) / 255.0,
            [v, w] => f64::from(u16::from_le_bytes([v, w])) / 65_535.0,
            [a, b, c, d] => f64::from(f32::from_le_bytes([a, b, c, d])),
            _ => 0.0,
        };
        let read = |bytes: &[u8]| {
            let mut color = [0; 3];
            for (channel, b) in color.iter_mut().zip(bytes.chunks_exact(component_bytes)) {
                *channel = srgb_from_linear(linear(b));
            }
            color
        };
        Ok(elements.iter().map(read).collect())
    }

    /// Vertex indices of any integer type.
    pub fn indices(&mut self, index: usize, place: &str) -> Result<Vec<u32>, ExportError> {
        let elements = self.elements(index, &[("SCALAR", 1)], place)?;
        if elements.accessor.component_type == FLOAT {
            return Err(bad(place, "integer indices", "floats".to_owned()));
        }
        let read = |bytes: &[u8]| {
            let mut le = [0; 4];
            le[..bytes.len()].copy_from_slice(bytes);
            u32::from_le_bytes(le)
        };
        Ok(elements.iter().map(read).collect())
    }

    /// Finds an accessor, one of `kinds` (name, components), and checks all its numbers against the file.
    fn elements(
        &mut self,
        index: usize,
        kinds: &[(&str, usize)],
        place: &str,
    ) -> Result<Elements<'a>, ExportError> {
        let document = self.document;
        let place = format!("{place}, accessors[{index}]");
        let accessor =
            document.accessors.get(index).ok_or_else(|| bad(&place, "an accessor", "none".to_owned()))?;
        if accessor.sparse.is_some() {
            return Err(unsupported(&place, "a sparse accessor".to_owned()));
        }
        let Some(&(_, components)) = kinds.iter().find(|(kind, _)| *kind == accessor.kind) else {
            let names: Vec<_> = kinds.iter().map(|(kind, _)| *kind).collect();
            return Err(bad(&place, &names.join(" or "), quoted(&accessor.kind)));
        };
        let component_bytes = match accessor.component_type {
            UNSIGNED_BYTE => 1,
            UNSIGNED_SHORT => 2,
            UNSIGNED_INT | FLOAT => 4,
            other => return Err(unsupported(&place, format!("component type {other}"))),
        };
        let element_bytes = components * component_bytes;
        let (view, stride) = self.view(accessor, element_bytes, &place)?;
        // Bytes from the first element to the end of the last.
        let needed = match accessor.count {
            0 => Some(0),
            count => (count - 1).checked_mul(stride).and_then(|n| n.checked_add(element_bytes)),
        };
        let data = needed.and_then(|length| window(view, accessor.byte_offset, length)).ok_or_else(|| {
            let found = format!("{} of {stride} bytes at {}", accessor.count, accessor.byte_offset);
            bad(&place, &format!("elements within {} bytes", view.len()), found)
        })?;
        self.budget = self.budget.checked_sub(accessor.count).ok_or_else(|| {
            unsupported(&place, "a scene whose repeated data gives more elements than bytes".to_owned())
        })?;
        Ok(Elements { accessor, component_bytes, element_bytes, stride, data })
    }

    /// The bytes of an accessor's buffer view, and its stride.
    fn view(
        &self,
        accessor: &Accessor,
        element_bytes: usize,
        place: &str,
    ) -> Result<(&'a [u8], usize), ExportError> {
        let Some(index) = accessor.buffer_view else {
            return Err(unsupported(place, "an accessor without a buffer view".to_owned()));
        };
        let view = self
            .document
            .buffer_views
            .get(index)
            .ok_or_else(|| bad(place, "a buffer view", format!("view {index}")))?;
        let place = format!("bufferViews[{index}]");
        let buffer = self
            .document
            .buffers
            .get(view.buffer)
            .ok_or_else(|| bad(&place, "a buffer", format!("buffer {}", view.buffer)))?;
        if view.buffer != 0 || buffer.uri.is_some() {
            return Err(unsupported(&place, "a buffer outside the file".to_owned()));
        }
        let stride = view.byte_stride.unwrap_or(element_bytes);
        if !(element_bytes..=MAX_STRIDE).contains(&stride) {
            let expected = format!("a stride of {element_bytes} to {MAX_STRIDE} bytes");
            return Err(bad(&place, &expected, stride.to_string()));
        }
        let buffer = &self.binary[..self.binary.len().min(buffer.byte_length)];
        let bytes = window(buffer, view.byte_offset, view.byte_length).ok_or_else(|| {
            let found = format!("{} at {}", view.byte_length, view.byte_offset);
            bad(&place, &format!("bytes within {}", buffer.len()), found)
        })?;
        Ok((bytes, stride))
    }
}

fn window(bytes: &[u8], start: usize, length: usize) -> Option<&[u8]> {
    bytes.get(start..start.checked_add(length)?)
}

pub(super) fn bad(place: &str, expected: &str, found: String) -> ExportError {
    ExportError::malformed(FORMAT, place, expected, found)
}

pub(super) fn unsupported(place: &str, feature: String) -> ExportError {
    let hint = "save it again as a plain GLB of one file";
    ExportError::Unsupported { format: FORMAT, place: place.to_owned(), feature, hint }
}
