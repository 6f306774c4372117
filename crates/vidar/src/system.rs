//! Hardware of this machine, as reported by the system.

use serde::Serialize;
use std::io::Read;
use std::path::Path;

/// Machine and limits.
#[derive(Clone, Debug, Serialize)]
pub struct Hardware {
    /// Operating system and architecture.
    pub platform: String,
    /// CPU name, if the system reports it.
    pub cpu: Option<String>,
    /// Instruction sets used by the kernels.
    pub cpu_features: Vec<&'static str>,
    /// Threads that this process may use.
    pub threads: usize,
    /// Memory, bytes, if the system reports it.
    pub memory_bytes: Option<u64>,
}

/// Queries the machine.
pub fn hardware() -> Hardware {
    Hardware {
        platform: format!("{}-{}", std::env::consts::OS, std::env::consts::ARCH),
        cpu: field_of("/proc/cpuinfo", "model name"),
        cpu_features: cpu_features(),
        threads: rayon::current_num_threads(),
        memory_bytes: kib_of("/proc/meminfo", "MemTotal"),
    }
}

/// Largest resident memory of this process so far, bytes.
pub fn peak_memory_bytes() -> Option<u64> {
    kib_of("/proc/self/status", "VmHWM")
}

/// Resets the peak, if the system supports it (Linux).
pub fn reset_peak_memory() {
    // On other systems, or without permission, the peak stays that of the whole process: an upper bound.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// Gives freed memory back to the system.
///
/// glibc keeps what was freed in small pieces, as the blocks of a volume are: in the demo 200 MB, which counted on while the map was evaluated.
/// Other allocators do it by themselves or have no such call.
pub fn release_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: malloc_trim(3) takes no pointer and may be called at any time, from any thread.
    unsafe {
        libc::malloc_trim(0);
    }
}

fn cpu_features() -> Vec<&'static str> {
    #[cfg(target_arch = "x86_64")]
    {
        let all = [
            ("sse4.2", std::arch::is_x86_feature_detected!("sse4.2")),
            ("avx2", std::arch::is_x86_feature_detected!("avx2")),
            ("fma", std::arch::is_x86_feature_detected!("fma")),
            ("avx512f", std::arch::is_x86_feature_detected!("avx512f")),
            ("avx512bf16", std::arch::is_x86_feature_detected!("avx512bf16")),
        ];
        all.into_iter().filter(|(_, there)| *there).map(|(name, _)| name).collect()
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        Vec::new()
    }
}

fn field_of(file: impl AsRef<Path>, key: &str) -> Option<String> {
    let text = std::fs::read_to_string(file).ok()?;
    let line = text.lines().find(|l| l.split(':').next().is_some_and(|k| k.trim() == key))?;
    line.split_once(':').map(|(_, value)| value.trim().to_owned())
}

fn kib_of(file: &str, key: &str) -> Option<u64> {
    let value = field_of(file, key)?;
    value.split_whitespace().next()?.parse::<u64>().ok()?.checked_mul(1024)
}

/// Reads a file of at most `limit` bytes: what is larger, or has no end, is refused and never held in memory.
///
/// # Errors
/// The file cannot be read; `InvalidData` beyond the limit.
pub fn read_up_to(path: &Path, limit: u64) -> std::io::Result<Vec<u8>> {
    let too_large = || {
        let message = format!("larger than {}", crate::run::bytes(limit));
        std::io::Error::new(std::io::ErrorKind::InvalidData, message)
    };
    let file = std::fs::File::open(path)?;
    let stated = file.metadata()?.len();
    if stated > limit {
        return Err(too_large());
    }
    let mut bytes = Vec::with_capacity(usize::try_from(stated).unwrap_or(0));
    // A device states no length.
    file.take(limit + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit { Err(too_large()) } else { Ok(bytes) }
}

/// As [`read_up_to`], as text.
///
/// # Errors
/// As [`read_up_to`], and bytes that are not UTF-8.
pub fn read_text_up_to(path: &Path, limit: u64) -> std::io::Result<String> {
    let bytes = read_up_to(path, limit)?;
    String::from_utf8(bytes).map_err(|e| std::io::Error::new(std::io::ErrorKind::InvalidData, e.to_string()))
}

/// Largest configuration or description that is read, bytes.
pub const MAX_CONFIG_BYTES: u64 = 4 << 20;
/// Largest JSON file of a run that is read back, bytes.
pub const MAX_JSON_BYTES: u64 = 256 << 20;
/// Largest cloud, mesh or picture that is read, bytes.
pub const MAX_CLOUD_BYTES: u64 = 4 << 30;

#[cfg(test)]
mod tests {
    #[test]
    #[cfg(target_os = "linux")]
    fn memory_and_peak_are_plausible() {
        let hardware = super::hardware();
        assert!(hardware.memory_bytes.unwrap() > 100 << 20);
        assert!(super::peak_memory_bytes().unwrap() > 1 << 20);
        assert!(hardware.threads >= 1);
    }
}
