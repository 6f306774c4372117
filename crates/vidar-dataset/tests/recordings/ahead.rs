//! Images decoded ahead: the same images in the same order as one after the other.

use crate::common::*;
use vidar_core::SensorEvent;
use vidar_dataset::Recording;

fn one_by_one(dataset: &Recording) -> Vec<Result<vidar_core::FrameImage, String>> {
    dataset.images.iter().map(|e| dataset.load_image(e).map_err(|e| e.to_string())).collect()
}

fn ahead(dataset: &Recording) -> Vec<Result<vidar_core::FrameImage, String>> {
    let images = dataset.images_ahead(dataset.images.iter());
    images.map(|(_, image)| image.map_err(|e| e.to_string())).collect()
}

#[test]
fn images_come_in_their_order_and_one_that_cannot_be_read_is_one_error() {
    let f = euroc();
    let d = f.open().unwrap();
    let all = ahead(&d);
    assert_eq!((all.len(), &all), (10, &one_by_one(&d)));
    assert!(all.windows(2).all(|w| w[0].is_ok() && w[0] != w[1]), "every image has another value");
    // One is damaged and one of another size after the recording was opened.
    f.write(&format!("mav0/cam0/data/{}.png", frame_ns(3)), b"\x89PNG no more");
    f.write(&format!("mav0/cam0/data/{}.png", frame_ns(7)), gray_png(3, 2, 0));
    let all = ahead(&d);
    let broken: Vec<usize> = all.iter().enumerate().filter(|(_, i)| i.is_err()).map(|(n, _)| n).collect();
    assert_eq!(broken, [3, 7]);
    assert_eq!(all, one_by_one(&d));
    assert!(all[7].as_ref().unwrap_err().contains("3x2"), "{:?}", all[7]);
}

#[test]
fn a_stream_of_events_is_the_one_that_reads_image_by_image() {
    let f = euroc();
    let d = f.open().unwrap();
    let mut cursor = vidar_dataset::EventCursor::default();
    let slow: Vec<SensorEvent> =
        std::iter::from_fn(|| d.next_event(&mut cursor)).map(Result::unwrap).collect();
    let fast: Vec<SensorEvent> = d.events().map(Result::unwrap).collect();
    assert_eq!(format!("{slow:?}"), format!("{fast:?}"));
    assert!(fast.iter().filter(|e| matches!(e, SensorEvent::Image(_))).count() == 10);
    // Given up in the middle, no thread is left waiting: this returns.
    assert_eq!(d.events().take(130).count(), 130);
}
