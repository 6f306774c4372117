use super::*;

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

#[test]
fn a_choice_is_told_from_a_sum() {
    for choice in
        ["Apache-2.0", "MIT OR Apache-2.0", "MIT/Apache-2.0", "Apache-2.0 / MIT", "Zlib OR Apache-2.0 OR MIT"]
    {
        assert!(is_offered_under_apache(choice), "{choice}");
    }
    for other in
        ["MIT", "Apache-2.0 AND ISC", "(MIT OR Apache-2.0) AND Unicode-3.0", "Apache-2.0 WITH LLVM-exception"]
    {
        assert!(!is_offered_under_apache(other), "{other}");
    }
}

#[test]
fn copies_of_the_apache_licence_are_one_text_and_nothing_else_is() {
    let filled = APACHE.replace("\n", "\r\n   ") + "\n   Copyright 2017 Somebody\n";
    assert_eq!(common(&tidy(&filled)), tidy(APACHE));
    let two = format!("{APACHE}\n\n{}", MIT.repeat(3));
    assert_eq!(common(&two), two, "a file with another licence in it is kept");
    assert_eq!(common(MIT), MIT);
}

#[test]
fn texts_that_crates_share_are_written_once_with_all_their_names() {
    let users = |names: &[&str]| names.iter().map(|n| (*n).to_owned()).collect::<BTreeSet<_>>();
    let texts = BTreeMap::from([
        ("A".to_owned(), users(&["one 1.0.0"])),
        ("B".to_owned(), users(&["two 2.0.0", "three 3.0.0"])),
    ]);
    let file = assembled("list\n", &texts);
    assert!(file.find("three 3.0.0, two 2.0.0\n").unwrap() < file.find("one 1.0.0\n").unwrap(), "{file}");
    assert_eq!(file.matches("\nB\n").count(), 1);
    let long: Vec<&str> = vec!["a-crate-of-some-length 0.1.0"; 9];
    assert!(wrapped(&long).lines().all(|line| line.len() <= 100));
    assert_eq!(wrapped(&long).matches("0.1.0").count(), 9);
}

#[test]
fn what_is_linked_is_listed_and_what_only_tests_use_is_not() {
    let text = text(root()).unwrap();
    // The program, the feature `gpu`, another platform, the Python module.
    for linked in ["\nclap 4", "\nwgpu 30", "\nwindows-sys 0", "\npyo3 0", "\nureq 3"] {
        assert!(text.contains(linked), "{linked:?}");
    }
    for unlinked in ["\nproptest ", "\nassert_cmd ", "\ncbindgen ", "\ncargo_metadata ", "\nvidar-core "] {
        assert!(!text.contains(unlinked), "{unlinked:?}");
    }
    for notice in
        ["Permission is hereby granted", "SIL OPEN FONT LICENSE", "TERMS AND CONDITIONS FOR USE", "Unicode"]
    {
        assert!(text.contains(notice), "{notice:?}");
    }
}

#[test]
fn an_old_file_is_reported_with_the_first_line_that_differs() {
    assert_eq!(difference("a\r\nb\r\n", "a\nb\n"), None);
    let stale = difference("a 1\nb 1\n", "a 1\nb 2\n").unwrap();
    assert!(stale.contains("\"b 2\"") && stale.contains("cargo xtask third-party"), "{stale}");
    assert!(difference("", "a\n").is_some() && difference("a\nb\n", "a\n").is_some());
}
