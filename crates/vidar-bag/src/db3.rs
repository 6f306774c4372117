//! ROS 2 bags in SQLite: the tables `topics` and `messages`.

use crate::error::BagError;
use crate::file::BagFile;
use crate::index::{Encoding, FileIndex, FileTopic, NO_CHUNK, plain_type};
use crate::sqlite::{Database, RowPlace, Table, Value, values};
use vidar_core::Warning;

/// An open bag in SQLite, with the columns of its messages.
#[derive(Debug)]
pub(crate) struct Db3 {
    database: Database,
    data: usize,
}

/// Lists the messages of a database.
pub(crate) fn index(file: BagFile) -> Result<(Db3, FileIndex), BagError> {
    let database = Database::open(file)?;
    let file = database.file();
    let (topics, messages) = (table(&database, "topics")?, table(&database, "messages")?);
    let mut index = FileIndex::default();
    let column = |table: &Table, name: &str| {
        let missing = || file.malformed(0, "a table without this column", name);
        table.column(name).ok_or_else(missing)
    };
    let (name, kind, format) =
        (column(&topics, "name")?, column(&topics, "type")?, column(&topics, "serialization_format")?);
    database.rows(topics.root, &mut |place, row| {
        // A row of topics can be longer than its page (the definition of its quality of service is in it).
        let whole = database.row(place)?;
        let payload = whole.as_ref().map_or(&row.payload, |w| &w.payload);
        let Some(values) = values(payload) else { return Ok(()) };
        let text = |column: usize| values.get(column).and_then(Value::text).unwrap_or_default().to_string();
        if let Ok(id) = u32::try_from(row.id) {
            index.declare(file, id, || FileTopic {
                name: text(name),
                message_type: plain_type(&text(kind)),
                encoding: Encoding::from_name(&text(format)),
                places: Vec::new(),
            })?;
        }
        Ok(())
    })?;
    let (topic, time, data) =
        (column(&messages, "topic_id")?, column(&messages, "timestamp")?, column(&messages, "data")?);
    let mut unknown = 0;
    let missing = database.rows(messages.root, &mut |place, row| {
        let values = values(&row.payload).unwrap_or_default();
        let integer = |column: usize| values.get(column).and_then(Value::integer);
        let id = integer(topic).and_then(|id| u32::try_from(id).ok());
        if let (Some(id), Some(time)) = (id, integer(time)) {
            let offset = u64::from(place.page) << 16 | u64::from(place.cell);
            unknown += usize::from(!index.add(file, id, time, NO_CHUNK, offset)?);
        }
        Ok(())
    })?;
    let place = file.path().display();
    // Large messages go on in pages of their own, which may lie behind the end.
    let lost = if missing > 0 || database.is_cut_off() { keep_whole(&database, &mut index) } else { 0 };
    if missing + lost > 0 {
        let message = format!(
            "the bag is cut off: {missing} pages of its messages are missing, and {lost} other messages are not whole; the {} that are whole are listed",
            index.messages
        );
        index.warnings.push(Warning::degraded("bag-cut-off", message).at(place));
    } else if unknown > 0 {
        let message = format!("{unknown} messages belong to topics that no row describes; left out");
        index.warnings.push(Warning::degraded("bag-connection", message).at(place));
    }
    if database.pages_from_log() > 0 {
        let message = format!(
            "the bag was not closed; {} pages are read from its write-ahead log (-wal)",
            database.pages_from_log()
        );
        index.warnings.push(Warning::new("bag-not-closed", message).at(file.path().display()));
    }
    Ok((Db3 { database, data }, index))
}

/// Leaves out messages of which a page is missing; returns how many.
fn keep_whole(database: &Database, index: &mut FileIndex) -> usize {
    let is_whole = |&(_, _, offset): &(i64, u32, u64)| matches!(database.row(place_of(offset)), Ok(Some(_)));
    let before = index.messages;
    for topic in index.topics.values_mut() {
        topic.places.retain(is_whole);
    }
    index.messages = index.topics.values().map(|t| t.places.len()).sum();
    before - index.messages
}

fn place_of(offset: u64) -> RowPlace {
    RowPlace { page: (offset >> 16) as u32, cell: offset as u16 }
}

fn table(database: &Database, name: &str) -> Result<Table, BagError> {
    let missing = || BagError::NotABag {
        path: database.file().path().to_path_buf(),
        found: format!("an SQLite database without a table {name:?}"),
        expected: "the tables topics and messages of a ROS 2 bag".into(),
    };
    database.table(name)?.ok_or_else(missing)
}

impl Db3 {
    pub(crate) fn file(&self) -> &BagFile {
        self.database.file()
    }

    /// The bytes of a message; `None` where they are missing.
    pub(crate) fn message(&self, offset: u64) -> Result<Option<Vec<u8>>, BagError> {
        let Some(mut row) = self.database.row(place_of(offset))? else { return Ok(None) };
        let Some(Value::Blob(range)) = values(&row.payload).and_then(|v| v.get(self.data).cloned()) else {
            return Ok(None);
        };
        if range.end > row.payload.len() {
            return Ok(None);
        }
        row.payload.truncate(range.end);
        row.payload.drain(..range.start);
        Ok(Some(row.payload))
    }
}
