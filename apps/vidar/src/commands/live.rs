//! `vidar live`.

use super::run::{conclude, dry_run, request};
use crate::build::usage;
use crate::live_args::LiveArgs;
use crate::{Context, Outcome, progress};
use vidar::config::Origin;
use vidar::run::LiveOptions;

/// The preset of what is live, where none is given.
const PRESET: &str = "live";

/// The map while images come.
pub fn live(args: &LiveArgs, context: &Context) -> Outcome {
    let (mut request, thresholds) = request(&args.run, None, Some(PRESET), context)?;
    if let Some(place) = &args.publish {
        let place = toml::Value::String(place.clone());
        request.layered.value("link.publish", place, Origin::Flag("--publish"))?;
    }
    if args.run.dry_run {
        return dry_run(&request, context);
    }
    let threads = rayon::current_num_threads();
    let options = LiveOptions { is_realtime: args.realtime, odometry_threads: threads };
    let events = progress::events(&context.cli);
    // The map leaves one processor to the odometry, where there are several.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.saturating_sub(1).max(1)).build();
    let pool = pool.map_err(|e| usage(format!("cannot start threads: {e}"), "give a smaller --threads"))?;
    let outcome = pool.install(|| vidar::run::live(&request, &options, &events, &context.cancel))?;
    conclude(&outcome, &thresholds, context)
}
