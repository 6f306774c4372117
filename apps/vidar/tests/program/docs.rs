//! Documents cannot drift: every command in them parses, and the reference is what the definitions say.

use crate::support::{shared, vidar_in};
use clap::{CommandFactory, Parser};
use std::path::PathBuf;
use vidar_cli::args::Cli;

fn repository() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../..")).canonicalize().unwrap()
}

/// Words of a shell line; enough of quoting for documents.
fn words(line: &str) -> Vec<String> {
    let mut words = vec![String::new()];
    let mut quote = None;
    for c in line.chars() {
        match (quote, c) {
            (Some(q), c) if c == q => quote = None,
            (None, '\'' | '"') => quote = Some(c),
            (None, '#') if words.last().is_some_and(String::is_empty) => break,
            (None, c) if c.is_whitespace() => words.push(String::new()),
            (_, c) => words.last_mut().unwrap().push(c),
        }
    }
    words.retain(|w| !w.is_empty());
    words
}

/// Every `vidar …` and `cargo run … -- …` in the shell blocks of a document.
fn commands_in(text: &str) -> Vec<Vec<String>> {
    let mut found = Vec::new();
    let mut shell = false;
    for line in text.lines() {
        if let Some(language) = line.trim_start().strip_prefix("```") {
            shell = !shell && ["sh", "bash", "console"].contains(&language.trim());
        } else if shell {
            let line = line.trim().trim_start_matches("$ ");
            let words = words(line);
            let start = match words.first().map(String::as_str) {
                Some("vidar") => Some(1),
                Some("cargo") if words.get(1).is_some_and(|w| w == "run") => {
                    words.iter().position(|w| w == "--").map(|i| i + 1)
                }
                _ => None,
            };
            // A pipe or redirection ends the part that is ours.
            let own = |w: &&String| !["|", ">", "&&", ";"].contains(&w.as_str());
            found.extend(start.map(|s| words[s..].iter().take_while(own).cloned().collect()));
        }
    }
    found
}

fn parses(command: &[String]) -> Result<(), clap::Error> {
    Cli::try_parse_from(std::iter::once("vidar").chain(command.iter().map(String::as_str))).map(|_| ())
}

fn help_examples() -> Vec<String> {
    fn walk(command: &clap::Command, found: &mut Vec<String>) {
        let text = command.get_after_help().map(ToString::to_string).unwrap_or_default();
        found.extend(text.lines().filter_map(|l| l.trim().strip_prefix("vidar ").map(str::to_owned)));
        command.get_subcommands().for_each(|c| walk(c, found));
    }
    let mut found = Vec::new();
    walk(&Cli::command(), &mut found);
    found
}

#[test]
fn every_command_in_readme_and_documents_parses() {
    let root = repository();
    let mut documents = vec![root.join("README.md")];
    for folder in ["docs", "docs/guides", "docs/benchmark", "docs/recordings"] {
        let files = std::fs::read_dir(root.join(folder)).unwrap().map(|e| e.unwrap().path());
        documents.extend(files.filter(|p| p.extension().is_some_and(|e| e == "md")));
    }
    for name in ["TESTING.md", "CONTRIBUTING.md", "BENCHMARK.md"] {
        documents.extend(Some(root.join(name)).filter(|p| p.is_file()));
    }
    for document in documents {
        // A backslash at the end of a line carries the command on, as in a shell.
        let text = std::fs::read_to_string(&document).unwrap().replace("\\\n", " ");
        for command in commands_in(&text) {
            if let Err(error) = parses(&command) {
                panic!("{}: `vidar {}`: {error}", document.display(), command.join(" "));
            }
        }
    }
    let readme = std::fs::read_to_string(root.join("README.md")).unwrap();
    let commands = commands_in(&readme);
    assert!(commands.len() >= 4, "the README shows commands: {commands:?}");
    let first_screen: Vec<&str> = readme.lines().take(24).collect();
    let shown = first_screen.join("\n");
    assert!(
        shown.contains("cargo run --release -- demo") && shown.contains("cargo test --workspace"),
        "{shown}"
    );
}

#[test]
fn every_example_in_help_parses_and_every_verb_that_takes_something_has_examples() {
    let examples = help_examples();
    assert!(examples.len() >= 18, "{examples:?}");
    for example in &examples {
        parses(&words(example)).unwrap_or_else(|e| panic!("`vidar {example}`: {e}"));
    }
    for verb in [
        "run",
        "demo",
        "inspect",
        "convert",
        "eval",
        "export",
        "compare",
        "synth",
        "config explain",
        "explain",
    ] {
        assert!(examples.iter().any(|e| e.starts_with(verb)), "{verb} has no example");
    }
}

#[test]
fn examples_in_help_that_need_no_data_run() {
    let ran = help_examples();
    let without_data = ["config", "explain", "doctor", "completions"];
    let mut count = 0;
    for example in ran.iter().filter(|e| without_data.iter().any(|v| e.starts_with(v))) {
        vidar_in(&shared().root, &words(example)).ends_with(0);
        count += 1;
    }
    assert!(count >= 4, "{count} examples ran");
}

#[test]
fn the_command_line_is_consistent() {
    Cli::command().debug_assert();
}

#[test]
fn reference_pages_are_what_the_definitions_say() {
    let folder = repository().join("docs/reference");
    let update = std::env::var_os("UPDATE_DOCS").is_some();
    for (name, text) in vidar_cli::reference::pages().unwrap() {
        let path = folder.join(name);
        if update {
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(&path, &text).unwrap();
        }
        let committed = std::fs::read_to_string(&path).unwrap_or_default();
        let line = committed.lines().zip(text.lines()).position(|(a, b)| a != b);
        assert!(
            committed == text,
            "docs/reference/{name} is out of date (first difference in line {:?}); run UPDATE_DOCS=1 cargo test -p vidar-cli --test program reference",
            line.map(|l| l + 1)
        );
    }
}

#[test]
fn the_words_of_this_test_are_split_as_a_shell_does() {
    assert_eq!(words("run 'a b' --set x=1   # why"), ["run", "a b", "--set", "x=1"]);
    let text = "```sh\nvidar demo | head\n```\nvidar prose\n```text\nvidar no\n```\n";
    assert_eq!(commands_in(text), [["demo"]]);
}
