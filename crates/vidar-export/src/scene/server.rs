//! An MCAP file, played back to Foxglove over its websocket on this computer.

use super::playback::Playback;
use crate::error::ExportError;
use foxglove::websocket::{
    Capability, ChannelView, Client, PlaybackCommand, PlaybackControlRequest, PlaybackState, PlaybackStatus,
    ServerListener,
};
use foxglove::{
    Context, PartialMetadata, RawChannel, Schema, SinkId, WebSocketServer, WebSocketServerHandle,
};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use thiserror::Error;

/// Only programs of this computer can connect.
const HOST: &str = "127.0.0.1";
/// Messages are sent in steps of this length: half the period of a display.
const STEP: Duration = Duration::from_millis(8);

/// Why a file is not served.
#[derive(Debug, Error)]
pub enum ServerError {
    /// The file is none, or cannot be read.
    #[error(transparent)]
    File(#[from] ExportError),
    /// The port is taken, or not allowed.
    #[error("cannot listen on {HOST}:{port}: {reason}")]
    Port {
        /// As asked for.
        port: u16,
        /// The system's reason.
        reason: String,
    },
}

/// Where the playback is, and what viewers have asked for since the last step.
struct Player {
    /// Time that has been played, ns.
    now: u64,
    begin: u64,
    end: u64,
    is_playing: bool,
    speed: f32,
    /// The time was set: what is shown then is to be sent anew.
    has_jumped: bool,
    /// Viewers that began to listen to a topic.
    subscribed: Vec<(SinkId, String)>,
}

impl Player {
    fn state(&self, did_seek: bool) -> PlaybackState {
        let status = match (self.is_playing, self.now == self.end) {
            (true, _) => PlaybackStatus::Playing,
            (false, true) => PlaybackStatus::Ended,
            (false, false) => PlaybackStatus::Paused,
        };
        PlaybackState {
            status,
            current_time: self.now,
            playback_speed: self.speed,
            did_seek,
            request_id: None,
        }
    }

    fn control(&mut self, request: &PlaybackControlRequest) -> PlaybackState {
        self.is_playing = request.playback_command == PlaybackCommand::Play;
        if request.playback_speed.is_finite() && request.playback_speed > 0.0 {
            self.speed = request.playback_speed;
        }
        let again = self.is_playing && self.now == self.end;
        let target = request.seek_time.or(again.then_some(self.begin));
        if let Some(time) = target {
            self.now = time.clamp(self.begin, self.end);
            self.has_jumped = true;
        }
        self.state(target.is_some())
    }

    /// Goes on by a time of the clock on the wall; whether the end was reached with it.
    fn advance(&mut self, elapsed: Duration) -> bool {
        if !self.is_playing {
            return false;
        }
        let step = elapsed.mul_f32(self.speed).as_nanos();
        self.now = self.now.saturating_add(u64::try_from(step).unwrap_or(u64::MAX)).min(self.end);
        self.is_playing = self.now < self.end;
        !self.is_playing
    }
}

/// What viewers ask for, kept until the next step.
struct Requests(Arc<Mutex<Player>>);

fn locked(player: &Mutex<Player>) -> MutexGuard<'_, Player> {
    player.lock().unwrap_or_else(PoisonError::into_inner)
}

impl ServerListener for Requests {
    fn on_subscribe(&self, client: Client, channel: ChannelView<'_>) {
        if let Some(sink) = client.sink_id() {
            locked(&self.0).subscribed.push((sink, channel.topic().to_owned()));
        }
    }

    fn on_playback_control_request(&self, request: PlaybackControlRequest) -> Option<PlaybackState> {
        Some(locked(&self.0).control(&request))
    }
}

/// A file that is being served.
pub struct SceneServer {
    handle: WebSocketServerHandle,
    playback: Playback,
    channels: BTreeMap<String, Arc<RawChannel>>,
    player: Arc<Mutex<Player>>,
    _context: Arc<Context>,
}

impl SceneServer {
    /// Opens an MCAP file and listens on a port of this computer; 0 takes any that is free.
    ///
    /// # Errors
    /// The file is none that can be played, or the port is taken.
    pub fn start(path: &Path, port: u16) -> Result<Self, ServerError> {
        let playback = Playback::open(path)?;
        let (begin, end) = playback.times();
        let context = Context::new();
        let mut channels = BTreeMap::new();
        for channel in playback.channels() {
            let schema = channel.schema.as_ref();
            let schema = schema.map(|s| Schema::new(&s.name, &s.encoding, s.data.clone().into_owned()));
            let built = context
                .channel_builder(&channel.topic)
                .message_encoding(&channel.message_encoding)
                .schema(schema)
                .build_raw()
                .map_err(|e| playback.malformed("a channel with an encoding", e))?;
            channels.insert(channel.topic.clone(), built);
        }
        let player = Player {
            now: begin,
            begin,
            end,
            is_playing: true,
            speed: 1.0,
            has_jumped: true,
            subscribed: Vec::new(),
        };
        let player = Arc::new(Mutex::new(player));
        let name = path.file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
        let handle = WebSocketServer::new()
            .name(name)
            .bind(HOST, port)
            .context(&context)
            .capabilities([Capability::Time])
            .playback_time_range(begin, end)
            .listener(Arc::new(Requests(player.clone())))
            .start_blocking()
            .map_err(|e| ServerError::Port { port, reason: e.to_string() })?;
        Ok(Self { handle, playback, channels, player, _context: context })
    }

    /// The address that a viewer connects to.
    pub fn address(&self) -> String {
        format!("ws://{HOST}:{}", self.handle.port())
    }

    /// A link that opens Foxglove's page with this address.
    pub fn app_url(&self) -> String {
        self.handle.app_url().to_string()
    }

    /// Plays until `stopped`, waiting for viewers where there are none.
    ///
    /// # Errors
    /// The file cannot be read any more.
    pub fn play(mut self, stopped: impl Fn() -> bool) -> Result<(), ExportError> {
        let mut last = Instant::now();
        while !stopped() {
            std::thread::sleep(STEP);
            let elapsed = last.elapsed();
            last = Instant::now();
            // Nothing is missed while nobody looks.
            if self.handle.client_count() > 0 {
                self.step(elapsed)?;
            }
        }
        let _ended = self.handle.stop();
        Ok(())
    }

    fn step(&mut self, elapsed: Duration) -> Result<(), ExportError> {
        let (ended, now, has_jumped, subscribed) = {
            let mut player = locked(&self.player);
            let has_jumped = std::mem::take(&mut player.has_jumped);
            let ended = !has_jumped && player.advance(elapsed);
            (ended, player.now, has_jumped, std::mem::take(&mut player.subscribed))
        };
        if has_jumped {
            self.playback.seek(now);
            for (topic, channel) in &self.channels {
                for message in self.playback.state(topic, now)? {
                    channel.log_with_meta(&message.data, PartialMetadata::with_log_time(message.time));
                }
            }
        }
        while let Some((topic, message)) = self.playback.next_until(now)? {
            if let Some(channel) = self.channels.get(&topic) {
                channel.log_with_meta(&message.data, PartialMetadata::with_log_time(message.time));
            }
        }
        for (sink, topic) in subscribed {
            let Some(channel) = self.channels.get(&topic) else { continue };
            for message in self.playback.state(&topic, now)? {
                let time = PartialMetadata::with_log_time(message.time);
                channel.log_with_meta_to_sink(&message.data, time, Some(sink));
            }
        }
        self.handle.broadcast_time(now);
        if ended {
            self.handle.broadcast_playback_state(locked(&self.player).state(false));
        }
        Ok(())
    }
}
