//! The reference pages under `docs/reference/`, generated from the definitions in the source.

use crate::args::Cli;
use clap::{Command, CommandFactory};
use vidar::config::{PRESETS, explain, schema};
use vidar::{Error, error::CODES};

const MADE: &str = "Generated from the definitions in the source; do not edit. \
    `UPDATE_DOCS=1 cargo test -p vidar-cli --test program reference` writes it anew.";

/// File name and text of every page.
pub fn pages() -> Result<[(&'static str, String); 3], Error> {
    Ok([("cli.md", cli()), ("config.md", config()?), ("errors.md", errors())])
}

fn cli() -> String {
    let mut program = Cli::command().term_width(100).color(clap::ColorChoice::Never);
    program.build();
    let mut text = format!("# Command line\n\n{MADE}\n");
    describe(&mut program, &mut text);
    text
}

fn describe(command: &mut Command, text: &mut String) {
    let name = command.get_bin_name().unwrap_or("vidar").to_owned();
    let help = command.render_long_help().to_string();
    let help: Vec<&str> = help.lines().map(str::trim_end).collect();
    text.push_str(&format!("\n## {name}\n\n```text\n{}\n```\n", help.join("\n").trim_end()));
    for inner in command.get_subcommands_mut().filter(|c| c.get_name() != "help") {
        describe(inner, text);
    }
}

fn config() -> Result<String, Error> {
    let mut text = format!(
        "# Configuration\n\n{MADE}\n\nLayers, each overriding the ones before: defaults, `--preset`, `--config FILE` (TOML), \
         `VIDAR_SECTION__KEY`, `--set section.key=value`, flags.\n\n## Presets\n\n"
    );
    PRESETS.iter().for_each(|p| text.push_str(&format!("- `{}`: {}\n", p.name, p.about)));
    let schema = schema();
    let sections = schema["properties"].as_object().into_iter().flat_map(|o| o.keys());
    for section in sections {
        text.push_str(&format!("\n## {section}\n\n| Key | Default | Meaning |\n|---|---|---|\n"));
        for e in explain(section)? {
            text.push_str(&format!("| `{}` | `{}` | {} |\n", e.key, e.default, e.about.replace('|', "\\|")));
        }
    }
    Ok(text)
}

fn errors() -> String {
    let mut text = format!(
        "# Errors and exit codes\n\n{MADE}\n\n| Exit | Meaning |\n|--:|---|\n\
         | 0 | everything asked for was made |\n\
         | 1 | the input or the data cannot be used |\n\
         | 2 | the command line or the configuration is wrong |\n\
         | 3 | finished, but part of the result is missing or uncertain |\n\
         | 4 | memory, disk, a folder or a device is missing |\n\
         | 5 | a bound given with `--fail-above` or `--fail-below` was missed |\n\
         | 70 | a bug in VIDAR |\n\
         | 130 | interrupted; what was finished is on disk |\n\n| Code | Meaning |\n|---|---|\n"
    );
    CODES.iter().for_each(|(code, about)| text.push_str(&format!("| {code} | {about} |\n")));
    text
}
