//! `vidar explain CODE`.

use crate::build::usage;
use crate::{Outcome, print};
use vidar::ExitStatus;
use vidar::error::CODES;

/// What an error code means.
pub fn explain(code: &str) -> Outcome {
    let wanted = code.to_uppercase();
    let found: Vec<_> = CODES.iter().filter(|(c, _)| wanted == "ALL" || *c == wanted).collect();
    if found.is_empty() {
        return Err(usage(format!("{code:?} is not an error code"), "`vidar explain all` lists them"));
    }
    print::pairs(found.into_iter().map(|(code, about)| (*code, (*about).to_owned())));
    Ok(ExitStatus::Done)
}
