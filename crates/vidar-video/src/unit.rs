//! What the decoders of both codecs have in common.

use crate::picture::Picture;

/// Where parameter sets are kept, which decides how the parts of a unit are told apart.
#[derive(Clone, Debug)]
pub(crate) enum Parameters {
    /// In the container, as the box `avcC` or `hvcC`; parts of a unit have their length before them.
    Described(Vec<u8>),
    /// In the sequence itself, which is a byte stream (Annex B of both standards): the first ones of it.
    InStream(Vec<u8>),
}

/// What decodes access units in their order.
pub(crate) trait UnitDecoder {
    /// Whether nothing else is predicted from a unit, so that it need not be decoded unless its picture is wanted.
    fn is_disposable(&self, bytes: &[u8]) -> bool;

    /// Decodes the next unit; gives the pictures that come out, with the numbers of their units. The error is why this unit gave none.
    fn decode(&mut self, unit: usize, bytes: &[u8], is_last: bool) -> Result<Vec<(usize, Picture)>, String>;
}
