//! What the targets of videos share: a decoder's panic is an error of its frame, every other panic is a find.

use std::sync::Once;

/// Lets decoders panic as the program does (`apps/vidar`): on a thread of their own, where it becomes the error of one frame. The hook of
/// libFuzzer, which was set before and ends the process, stays for all other threads.
pub fn allow_panics_of_decoders() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            if std::thread::current().name() != Some(vidar_video::DECODER_THREAD) {
                before(panic);
            }
        }));
    });
}
