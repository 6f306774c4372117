//! The `vidar` program: parse, validate, call the library, print.

use std::process::ExitCode;

fn main() -> ExitCode {
    vidar_cli::main_with(std::env::args_os())
}
