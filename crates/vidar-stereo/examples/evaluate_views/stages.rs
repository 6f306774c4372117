//! Processor time by stage, from the spans of the crate.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Metadata, Subscriber};

thread_local! {
    static OPEN: RefCell<Vec<Open>> = const { RefCell::new(Vec::new()) };
}

/// An open span of a thread.
struct Open {
    /// Its name after those of the spans around it.
    path: String,
    /// Processor time when it was opened, nanoseconds.
    begin: u64,
    /// That of the spans inside so far, nanoseconds.
    inside: u64,
}

/// Sums the processor time of each span's thread without that of the spans inside.
#[derive(Default)]
pub struct Stages {
    names: Mutex<BTreeMap<u64, &'static str>>,
    spent: Mutex<BTreeMap<String, (u64, u64)>>,
    next: AtomicU64,
}

impl Stages {
    /// Prints milliseconds a view, the longest stage first. Spans that wait for other threads contain their work, so the
    /// table is exact on one thread.
    pub fn print(&self, views: usize) {
        let Ok(spent) = self.spent.lock() else { return };
        let mut rows: Vec<_> = spent.iter().collect();
        rows.sort_by_key(|(_, (nanos, _))| std::cmp::Reverse(*nanos));
        let ms = |nanos: u64| nanos as f64 * 1e-6 / views.max(1) as f64;
        for (name, (nanos, calls)) in &rows {
            println!("  {name:36} {:7.2} ms a view, {calls} calls", ms(*nanos));
        }
        println!("  {:36} {:7.2} ms a view", "all stages", ms(rows.iter().map(|(_, s)| s.0).sum()));
    }
}

/// Processor time of this thread so far, nanoseconds; zero where the system does not report it.
fn thread_nanos() -> u64 {
    let stat = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    stat.split_whitespace().next().and_then(|n| n.parse().ok()).unwrap_or(0)
}

impl Subscriber for Stages {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.is_span() && metadata.target().starts_with("vidar_stereo")
    }

    fn new_span(&self, span: &Attributes<'_>) -> Id {
        let id = self.next.fetch_add(1, Ordering::Relaxed) + 1;
        if let Ok(mut names) = self.names.lock() {
            names.insert(id, span.metadata().name());
        }
        Id::from_u64(id)
    }

    fn enter(&self, span: &Id) {
        let name =
            self.names.lock().ok().and_then(|names| names.get(&span.into_u64()).copied()).unwrap_or("?");
        OPEN.with_borrow_mut(|open| {
            let path = open.last().map_or_else(|| name.to_owned(), |outer| format!("{}, {name}", outer.path));
            open.push(Open { path, begin: thread_nanos(), inside: 0 });
        });
    }

    fn exit(&self, _: &Id) {
        // Spans of a thread are closed in the reverse order.
        let Some(span) = OPEN.with_borrow_mut(Vec::pop) else { return };
        let whole = thread_nanos().saturating_sub(span.begin);
        OPEN.with_borrow_mut(|open| {
            if let Some(outer) = open.last_mut() {
                outer.inside += whole;
            }
        });
        if let Ok(mut spent) = self.spent.lock() {
            let entry = spent.entry(span.path).or_default();
            entry.0 += whole.saturating_sub(span.inside);
            entry.1 += 1;
        }
    }

    fn try_close(&self, span: Id) -> bool {
        if let Ok(mut names) = self.names.lock() {
            names.remove(&span.into_u64());
        }
        true
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}
    fn record_follows_from(&self, _: &Id, _: &Id) {}
    fn event(&self, _: &Event<'_>) {}
}
