//! Writing of CDR, little-endian: each number is aligned to its own size, counted from behind the encapsulation.

use vidar_core::{Se3, Timestamp};

const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

pub(super) struct Cdr {
    bytes: Vec<u8>,
}

impl Cdr {
    pub fn new(capacity: usize) -> Self {
        let mut bytes = Vec::with_capacity(capacity + 64);
        bytes.extend(ENCAPSULATION);
        Self { bytes }
    }

    pub fn finish(self) -> Vec<u8> {
        self.bytes
    }

    fn align(&mut self, to: usize) {
        let at = self.bytes.len() - ENCAPSULATION.len();
        self.bytes.resize(ENCAPSULATION.len() + at.next_multiple_of(to), 0);
    }

    pub fn u8(&mut self, value: u8) {
        self.bytes.push(value);
    }

    pub fn u32(&mut self, value: u32) {
        self.align(4);
        self.bytes.extend(value.to_le_bytes());
    }

    pub fn f32s(&mut self, values: &[f32]) {
        for value in values {
            self.align(4);
            self.bytes.extend(value.to_le_bytes());
        }
    }

    pub fn f64s(&mut self, values: &[f64]) {
        for value in values {
            self.align(8);
            self.bytes.extend(value.to_le_bytes());
        }
    }

    pub fn text(&mut self, text: &str) {
        self.u32(text.len() as u32 + 1);
        self.bytes.extend(text.as_bytes());
        self.bytes.push(0);
    }

    pub fn raw(&mut self, bytes: impl IntoIterator<Item = u8>) {
        self.bytes.extend(bytes);
    }

    /// `std_msgs/Header`. Stamps beyond 32-bit seconds are written as the last or first second there is.
    pub fn header(&mut self, stamp: Timestamp, frame: &str) {
        let nanos = stamp.nanos();
        let secs = nanos.div_euclid(1_000_000_000).clamp(i64::from(i32::MIN), i64::from(i32::MAX));
        self.u32(secs as i32 as u32);
        self.u32(nanos.rem_euclid(1_000_000_000) as u32);
        self.text(frame);
    }

    /// `geometry_msgs/Pose`, and `Transform`, which has the same layout.
    pub fn pose(&mut self, pose: &Se3) {
        let t = &pose.translation;
        self.f64s(&[t.x, t.y, t.z]);
        self.f64s(&pose.rotation.quaternion_xyzw());
    }
}
