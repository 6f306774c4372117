//! What can go wrong with a device.

/// A device that is not there, does not suit, or failed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum GpuError {
    /// No adapter fits what was asked for.
    #[error(
        "no device {wanted}; looked for Vulkan, Metal and DirectX 12 adapters and found {found}. {advice}"
    )]
    NoAdapter {
        /// What was asked for.
        wanted: String,
        /// What there is.
        found: String,
        /// What to do about it.
        advice: String,
    },
    /// The adapter does not open.
    #[error("{adapter} does not open: {reason}")]
    NotOpened {
        /// Its name.
        adapter: String,
        /// What the driver said.
        reason: String,
    },
    /// The adapter lacks something that the shaders need.
    #[error("{adapter}: {what} is {found}, at least {needed} needed")]
    Unsuitable {
        /// Its name.
        adapter: String,
        /// The limit or feature.
        what: &'static str,
        /// What it has.
        found: u64,
        /// What is needed.
        needed: u64,
    },
    /// One buffer is larger than the device binds.
    #[error(
        "{what} needs {bytes} bytes in one buffer, {adapter} binds at most {most}; take fewer views or a smaller size"
    )]
    BufferTooLarge {
        /// What the buffer is for.
        what: String,
        /// Its size.
        bytes: u64,
        /// The device.
        adapter: String,
        /// Its limit.
        most: u64,
    },
    /// The device has no memory left.
    #[error(
        "out of device memory: {what} needs {bytes} bytes beside {held} held on {adapter}; take fewer views, a smaller size or a smaller model"
    )]
    OutOfMemory {
        /// What the memory is for.
        what: String,
        /// What was asked for.
        bytes: u64,
        /// What this process holds there.
        held: u64,
        /// The device.
        adapter: String,
    },
    /// More than the caller allowed.
    #[error("{what} needs {bytes} bytes of device memory beside {held} held, {allowed} are allowed")]
    OverBudget {
        /// What the memory is for.
        what: String,
        /// What was asked for.
        bytes: u64,
        /// What is held.
        held: u64,
        /// The allowance.
        allowed: u64,
    },
    /// The device went away: driver reset, unplugged, or a dispatch that ran too long.
    #[error("{adapter} was lost: {reason}; open it again, and if it recurs take fewer views at a time")]
    Lost {
        /// The device.
        adapter: String,
        /// What the driver said.
        reason: String,
    },
    /// The device or its driver refused an operation.
    #[error("{adapter}: {reason}")]
    Refused {
        /// The device.
        adapter: String,
        /// What it said.
        reason: String,
    },
    /// A layer whose sizes the shaders do not cover.
    #[error("{layer}: {what} is {found}, the device needs {expected}")]
    Shape {
        /// The layer.
        layer: String,
        /// Which size.
        what: &'static str,
        /// Its value.
        found: usize,
        /// What it may be.
        expected: &'static str,
    },
}
