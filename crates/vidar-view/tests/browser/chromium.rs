//! A Chromium without a window, driven over its DevTools protocol: real mouse and key events on a real page.

use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;
use tungstenite::client::IntoClientRequest;
use tungstenite::{Message, WebSocket};

/// Longest time that an answer may take: software rendering on a busy machine.
const PATIENCE: Duration = Duration::from_secs(120);
/// Names of the program, and the variable that names another.
const NAMES: [&str; 4] = ["chromium", "chromium-browser", "google-chrome", "chrome"];
const VARIABLE: &str = "CHROMIUM";

/// A page in a browser; both end with the test.
pub struct Page {
    child: Child,
    socket: WebSocket<TcpStream>,
    session: String,
    next: u64,
    /// Addresses of everything that the page asked for.
    pub requests: Vec<String>,
    /// Errors on the page's console.
    pub errors: Vec<String>,
    _profile: TempDir,
}

impl Drop for Page {
    fn drop(&mut self) {
        let _ended = self.child.kill().and_then(|()| self.child.wait());
    }
}

/// The browser's name, or none, which is said.
pub fn browser() -> Option<String> {
    let named = std::env::var(VARIABLE).ok();
    let runs = |name: &String| {
        let version =
            Command::new(name).arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
        version.is_ok_and(|s| s.success())
    };
    let found = named.into_iter().chain(NAMES.map(str::to_owned)).find(runs);
    if found.is_none() {
        eprintln!(
            "skipped: there is no Chromium (Debian: chromium; or name one in {VARIABLE}): the view was not drawn"
        );
    }
    found
}

impl Page {
    /// Opens a file in a window of this many pixels.
    pub fn open(browser: &str, file: &Path, fragment: &str, (width, height): (u32, u32)) -> Self {
        let profile = tempfile::tempdir().unwrap();
        let mut child = Command::new(browser)
            .args([
                "--headless=new",
                "--no-sandbox",
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                "--disable-background-networking",
                "--disable-component-update",
                "--disable-sync",
                "--disable-extensions",
                "--no-first-run",
                "--hide-scrollbars",
                "--force-device-scale-factor=1",
                "--remote-debugging-port=0",
            ])
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .arg(format!("--window-size={width},{height}"))
            .arg("about:blank")
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let address = lines
            .by_ref()
            .map_while(Result::ok)
            .find_map(|line| line.strip_prefix("DevTools listening on ").map(str::to_owned))
            .expect("the browser says where it listens");
        // Its later talk is read, so that its pipe never fills.
        std::thread::spawn(move || lines.for_each(drop));
        let host = address.strip_prefix("ws://").unwrap().split('/').next().unwrap();
        let stream = TcpStream::connect(host).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let request = address.as_str().into_client_request().unwrap();
        let socket = tungstenite::client(request, stream).unwrap().0;
        let mut page = Self {
            child,
            socket,
            session: String::new(),
            next: 1,
            requests: Vec::new(),
            errors: Vec::new(),
            _profile: profile,
        };
        let target = page.call("Target.createTarget", json!({ "url": "about:blank" }));
        let attached =
            page.call("Target.attachToTarget", json!({ "targetId": target["targetId"], "flatten": true }));
        page.session = attached["sessionId"].as_str().unwrap().to_owned();
        for domain in ["Page", "Runtime", "Network"] {
            page.call(&format!("{domain}.enable"), json!({}));
        }
        let metrics = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": false });
        page.call("Emulation.setDeviceMetricsOverride", metrics);
        page.call("Page.navigate", json!({ "url": format!("file://{}{fragment}", file.display()) }));
        page.until("document.readyState === 'complete'");
        page
    }

    /// The answer to a command.
    pub fn call(&mut self, method: &str, params: Value) -> Value {
        let id = self.next;
        self.next += 1;
        let mut message = json!({ "id": id, "method": method, "params": params });
        if !self.session.is_empty() {
            message["sessionId"] = self.session.clone().into();
        }
        self.socket.send(Message::text(message.to_string())).unwrap();
        loop {
            let Message::Text(text) = self.socket.read().unwrap() else { continue };
            let answer: Value = serde_json::from_str(text.as_str()).unwrap();
            if answer["id"] == id {
                assert!(answer["error"].is_null(), "{method}: {}", answer["error"]);
                return answer["result"].clone();
            }
            let params = &answer["params"];
            match answer["method"].as_str() {
                Some("Network.requestWillBeSent") => {
                    self.requests.push(params["request"]["url"].as_str().unwrap_or_default().to_owned());
                }
                Some("Runtime.exceptionThrown") => self.errors.push(params["exceptionDetails"].to_string()),
                Some("Runtime.consoleAPICalled") if params["type"] == "error" => {
                    self.errors.push(params["args"].to_string());
                }
                _ => {}
            }
        }
    }

    /// The value of an expression.
    #[track_caller]
    pub fn value(&mut self, expression: &str) -> Value {
        let params = json!({ "expression": expression, "returnByValue": true, "awaitPromise": true });
        let answer = self.call("Runtime.evaluate", params);
        assert!(answer["exceptionDetails"].is_null(), "{expression}: {}", answer["exceptionDetails"]);
        answer["result"]["value"].clone()
    }

    /// Waits until an expression holds.
    #[track_caller]
    pub fn until(&mut self, expression: &str) {
        let start = Instant::now();
        while self.value(expression) != true {
            assert!(start.elapsed() < PATIENCE, "never came true: {expression}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// A mouse event at a place of the page. Modifiers: 8 is Shift.
    pub fn mouse(&mut self, kind: &str, (x, y): (f64, f64), buttons: u32, modifiers: u32) {
        let button = match (kind, buttons) {
            ("mouseMoved", 0) => "none",
            (_, 2) => "right",
            _ => "left",
        };
        let params = json!({
            "type": kind, "x": x, "y": y, "button": button, "buttons": buttons, "clickCount": 1, "modifiers": modifiers,
        });
        self.call("Input.dispatchMouseEvent", params);
    }

    /// A click.
    pub fn click(&mut self, at: (f64, f64), modifiers: u32) {
        self.mouse("mouseMoved", at, 0, modifiers);
        self.mouse("mousePressed", at, 1, modifiers);
        self.mouse("mouseReleased", at, 0, modifiers);
    }

    /// A drag in a few steps.
    pub fn drag(&mut self, from: (f64, f64), to: (f64, f64)) {
        self.mouse("mouseMoved", from, 0, 0);
        self.mouse("mousePressed", from, 1, 0);
        for i in 1..=5 {
            let share = f64::from(i) / 5.0;
            self.mouse(
                "mouseMoved",
                (from.0 + share * (to.0 - from.0), from.1 + share * (to.1 - from.1)),
                1,
                0,
            );
        }
        self.mouse("mouseReleased", to, 0, 0);
    }

    /// A key, pressed and released.
    pub fn key(&mut self, key: &str) {
        for kind in ["keyDown", "keyUp"] {
            self.call("Input.dispatchKeyEvent", json!({ "type": kind, "key": key }));
        }
    }

    /// A picture of what the window shows, as a PNG file.
    pub fn screenshot(&mut self) -> Vec<u8> {
        use base64::Engine;
        let answer = self.call("Page.captureScreenshot", json!({ "format": "png" }));
        base64::engine::general_purpose::STANDARD.decode(answer["data"].as_str().unwrap()).unwrap()
    }
}
