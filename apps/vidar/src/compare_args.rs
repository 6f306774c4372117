//! The command line of `vidar compare`.

use clap::{Args, ValueHint};
use std::path::PathBuf;

/// `vidar compare`.
#[derive(Args, Clone, Debug)]
pub struct CompareArgs {
    /// Folders of two to four runs; the others are placed in the world of the first and compared with it.
    #[arg(value_name = "RUN", required = true, value_hint = ValueHint::DirPath)]
    pub runs: Vec<PathBuf>,
    /// The page: one HTML file that needs nothing else.
    #[arg(short, long, value_name = "FILE", value_hint = ValueHint::FilePath, default_value = "compare.html", help_heading = "Output")]
    pub output: PathBuf,
    /// Replace a page that exists.
    #[arg(long, help_heading = "Output")]
    pub force: bool,
}
