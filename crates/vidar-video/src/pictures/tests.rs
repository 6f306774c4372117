use super::*;
use crate::picture::Colours;
use crate::unit::UnitDecoder;
use std::time::Duration;

fn unit(time_ns: i64, is_sync: bool) -> Unit {
    Unit { time_ns, is_sync }
}

#[test]
fn groups_are_cut_only_where_nothing_reaches_across() {
    let closed: Vec<Unit> = (0..30).map(|i| unit(i, i % 10 == 0)).collect();
    assert_eq!(groups(&closed), [0, 10, 20]);
    // Two pictures stored after the one at 10 are shown before it: they need the group before.
    let mut open = closed.clone();
    (open[10].time_ns, open[11].time_ns, open[12].time_ns) = (12, 10, 11);
    assert_eq!(groups(&open), [0, 20]);
    // Every picture alone: put together.
    let alone: Vec<Unit> = (0..20).map(|i| unit(i, true)).collect();
    assert_eq!(groups(&alone), [0, 8, 16]);
}

/// Decodes units of one byte into pictures of that value, and notes what it decoded. A unit of 255 hangs.
struct Fake(Arc<Mutex<Vec<usize>>>);

impl UnitDecoder for Fake {
    fn is_disposable(&self, _: &[u8]) -> bool {
        false
    }

    fn decode(&mut self, unit: usize, bytes: &[u8], _: bool) -> Result<Vec<(usize, Picture)>, String> {
        self.0.lock().unwrap().push(unit);
        if bytes == [255] {
            std::thread::sleep(Duration::from_secs(3));
        }
        let colours = Colours { is_full_range: true, is_bt709: true };
        // Large, so that few are kept.
        let luma = vec![bytes[0]; 4 << 20];
        let chroma = [vec![0; 1 << 20], vec![0; 1 << 20]];
        Ok(vec![(unit, Picture { width: 2048, height: 2048, luma, chroma, chroma_shift: [1, 1], colours })])
    }
}

struct Bytes(Vec<u8>);

impl AccessUnits for Bytes {
    fn read(&self, number: usize) -> Result<Vec<u8>, String> {
        self.0.get(number).map(|&b| vec![b]).ok_or_else(|| "no such unit".into())
    }
}

fn fake(bytes: Vec<u8>, group: usize) -> (Pictures, Arc<Mutex<Vec<usize>>>) {
    let units = (0..bytes.len()).map(|i| unit(i as i64, i % group == 0)).collect();
    let seen = Arc::new(Mutex::new(Vec::new()));
    let decoded = Arc::clone(&seen);
    let work = Work {
        units: Arc::new(Bytes(bytes)),
        make: Arc::new(move || Ok(Box::new(Fake(Arc::clone(&decoded))))),
        needed: None,
        broken: HashSet::new(),
        stated_size: (2048, 2048),
        limit: Duration::from_millis(300),
    };
    (Pictures::with_work(work, units, 0), seen)
}

fn value(pictures: &Pictures, unit: usize) -> u8 {
    pictures.picture(unit).unwrap().luma[0]
}

#[test]
fn pictures_are_the_same_in_any_order_and_in_order_are_decoded_once() {
    let (pictures, seen) = fake((0..100).collect(), 10);
    for i in 0..100 {
        assert_eq!(value(&pictures, i), i as u8);
    }
    let mut once = seen.lock().unwrap().clone();
    once.sort_unstable();
    assert_eq!(once, (0..100).collect::<Vec<_>>());
    for i in [50, 3, 99, 4, 0, 77, 76, 75] {
        assert_eq!(value(&pictures, i), i as u8);
    }
    // Again from the beginning.
    for i in 0..100 {
        assert_eq!(value(&pictures, i), i as u8);
    }
}

#[test]
fn looking_back_does_not_stop_the_reading_in_order() {
    let (pictures, seen) = fake((0..100).collect(), 10);
    for i in 0..100 {
        assert_eq!(value(&pictures, i), i as u8);
        // Twenty back, which is no longer kept.
        if i >= 20 && i % 5 == 0 {
            assert_eq!(value(&pictures, i - 20), i as u8 - 20);
        }
    }
    // Each once in order, and each at most once more for looking back, with some of the queue.
    assert!(seen.lock().unwrap().len() < 230, "{}", seen.lock().unwrap().len());
}

#[test]
fn a_later_start_decodes_from_the_picture_before_it_that_stands_alone() {
    let (pictures, seen) = fake((0..100).collect(), 10);
    assert_eq!(value(&pictures, 57), 57);
    drop(pictures);
    let seen = seen.lock().unwrap();
    assert_eq!(seen.iter().min(), Some(&50), "{seen:?}");
}

#[test]
fn groups_without_a_wanted_picture_are_not_decoded() {
    let (pictures, seen) = fake((0..100).collect(), 10);
    pictures.expect([2, 41, 43, 95].into_iter());
    for i in [2, 41, 43, 95] {
        assert_eq!(value(&pictures, i), i as u8);
    }
    let mut decoded = seen.lock().unwrap().clone();
    decoded.sort_unstable();
    assert_eq!(decoded, [0, 1, 2, 40, 41, 42, 43, 90, 91, 92, 93, 94, 95]);
    // One that was not expected is there all the same.
    assert_eq!(value(&pictures, 20), 20);
}

#[test]
fn after_a_hang_the_rest_is_read_and_after_the_second_nothing_more() {
    let mut bytes: Vec<u8> = (0..40).collect();
    (bytes[5], bytes[25]) = (255, 255);
    let (pictures, _) = fake(bytes, 10);
    let read = |i: usize| pictures.picture(i).map(|p| p.luma[0]);
    assert_eq!(read(4), Ok(4));
    assert!(read(5).is_err_and(|e| e.contains("did not finish")));
    assert_eq!((read(6), read(12)), (Ok(6), Ok(12)));
    assert!(read(25).is_err_and(|e| e.contains("did not finish")));
    assert!(read(30).is_err_and(|e| e.contains("hung on 2 pictures")));
}
