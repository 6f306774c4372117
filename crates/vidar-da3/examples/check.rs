//! Checks a model against reference files: `check FILE... [--precision P] [--head-precision P] [--exact-blocks N] [--isa I] [--device cpu|gpu|gpu:N|auto] [--weights DIR]`.

use std::path::PathBuf;
use vidar_da3::{Da3Options, check};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut options = Da3Options::default();
    let (mut weights, mut files) = (None, Vec::new());
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut value = || arguments.next().ok_or(format!("{argument} needs a value"));
        match argument.as_str() {
            "--precision" => options.precision = value()?.parse()?,
            "--head-precision" => options.head_precision = Some(value()?.parse()?),
            "--exact-blocks" => options.exact_blocks = Some(value()?.parse()?),
            "--device" => options.device = value()?.parse()?,
            "--isa" => options.isa = Some(value()?.parse()?),
            "--weights" => weights = Some(PathBuf::from(value()?)),
            "--on-demand" => options.residency = vidar_da3::Residency::OnDemand,
            _ => files.push(PathBuf::from(argument)),
        }
    }
    for file in files {
        use std::io::Write;
        let report = check::check_file(&file, weights.as_deref(), &options)?;
        write!(std::io::stdout(), "{report}")?;
    }
    Ok(())
}
