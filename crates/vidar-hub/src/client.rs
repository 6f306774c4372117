//! HTTP requests one after the other; redirects are followed here, not by the HTTP library.
//!
//! The hub states hash and length of a file in the response that redirects to its storage (`X-Linked-ETag`,
//! `X-Linked-Size`), and a token must not be sent to another host.

use crate::address::Address;
use crate::error::HubError;
use crate::settings::HubSettings;
use std::io::Read;
use std::time::Duration;
use ureq::Agent;
use ureq::http::HeaderMap;

/// Limit on redirects, above what a hub needs.
const MOST_REDIRECTS: usize = 10;
/// Limit on the size of headers, above what a hub sends, bytes.
const MOST_HEADER: usize = 32 << 10;
/// Characters of a response's explanation that an error message repeats.
const MOST_DETAIL: usize = 120;

/// How an attempt failed.
#[derive(Debug)]
pub(crate) enum Failure {
    /// Another attempt may succeed, after this wait if the server named one.
    Temporary(HubError, Option<Duration>),
    /// No attempt will succeed.
    Final(HubError),
}

/// Metadata of a file in the hub's responses, gathered along its redirects.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct FileMetadata {
    pub bytes: Option<u64>,
    pub sha256: Option<String>,
    pub revision: Option<String>,
}

/// A successful response.
pub(crate) struct Response {
    pub status: u16,
    pub headers: HeaderMap,
    pub metadata: FileMetadata,
    pub body: Box<dyn Read>,
}

/// HTTP client of one hub.
pub(crate) struct Client<'a> {
    agent: Agent,
    settings: &'a HubSettings,
    /// The repository's page, for error messages about missing access.
    page: String,
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Method {
    Head,
    /// Starting at this byte.
    Get(u64),
}

impl<'a> Client<'a> {
    pub fn new(settings: &'a HubSettings, page: String) -> Self {
        let silence = Some(settings.silence);
        let builder = Agent::config_builder()
            .max_redirects(0)
            .max_redirects_will_error(false)
            .http_status_as_error(false)
            .max_response_header_size(MOST_HEADER)
            .user_agent(concat!("vidar/", env!("CARGO_PKG_VERSION")))
            .accept_encoding("identity")
            .timeout_resolve(silence)
            .timeout_connect(silence)
            .timeout_per_read(silence)
            .timeout_recv_response(silence);
        let builder = if settings.proxy_from_environment { builder } else { builder.proxy(None) };
        Self { agent: builder.build().new_agent(), settings, page }
    }

    /// Requests `url` and follows redirects.
    pub fn ask(&self, method: Method, url: &str) -> Result<Response, Failure> {
        let redirect = |reason: String| Failure::Final(HubError::Redirect { url: url.to_owned(), reason });
        let start = Address::parse(url).ok_or_else(|| redirect("not an http address".to_owned()))?;
        let mut metadata = FileMetadata::default();
        let mut visited = vec![start.clone()];
        let mut here = start.clone();
        loop {
            let response = self.send(method, &here, here.same_origin(&start))?;
            let status = response.status().as_u16();
            gather(&mut metadata, response.headers());
            if !matches!(status, 301 | 302 | 303 | 307 | 308) {
                return self.finish(status, url, response, metadata, here.same_origin(&start));
            }
            let location =
                response.headers().get("location").and_then(|v| v.to_str().ok()).unwrap_or_default();
            let next = here.join(location);
            let next = next.ok_or_else(|| redirect(format!("redirected to {:?}", shortened(location))))?;
            if here.is_downgrade(&next) {
                return Err(redirect(format!("redirected from https to {next}")));
            }
            if visited.contains(&next) {
                return Err(redirect(format!("redirected in a loop, back to {next}")));
            }
            if visited.len() > MOST_REDIRECTS {
                return Err(redirect(format!("redirected more than {MOST_REDIRECTS} times")));
            }
            visited.push(next.clone());
            here = next;
        }
    }

    fn send(
        &self,
        method: Method,
        address: &Address,
        trusted: bool,
    ) -> Result<ureq::http::Response<ureq::Body>, Failure> {
        let url = address.to_string();
        let mut request = match method {
            Method::Head => self.agent.head(&url),
            Method::Get(from) => {
                let request = self.agent.get(&url);
                if from > 0 { request.header("range", format!("bytes={from}-")) } else { request }
            }
        };
        if let Some(token) = self.settings.token.as_ref().filter(|_| trusted) {
            request = request.header("authorization", format!("Bearer {token}"));
        }
        request.call().map_err(|e| {
            let reason = e.to_string();
            match e {
                ureq::Error::BadUri(_) | ureq::Error::Tls(_) | ureq::Error::InvalidProxyUrl => {
                    Failure::Final(HubError::Network { url, reason })
                }
                e if is_connection_failure(&e) => {
                    Failure::Temporary(HubError::NoConnection { url, reason }, None)
                }
                _ => Failure::Temporary(HubError::Network { url, reason }, None),
            }
        })
    }

    fn finish(
        &self,
        status: u16,
        url: &str,
        response: ureq::http::Response<ureq::Body>,
        metadata: FileMetadata,
        on_hub: bool,
    ) -> Result<Response, Failure> {
        let url = url.to_owned();
        let headers = response.headers().clone();
        match status {
            200 | 206 | 416 => {
                let body: Box<dyn Read> = Box::new(response.into_body().into_reader());
                Ok(Response { status, headers, metadata, body })
            }
            401 | 403 => {
                let detail = shortened(header(&headers, "x-error-message").unwrap_or_default());
                let (page, with_token) = (self.page.clone(), self.settings.token.is_some());
                let error = HubError::NoAccess { url, status, detail, page, with_token };
                // The storage refuses an expired signed address with this status; the hub signs a new one.
                Err(if on_hub { Failure::Final(error) } else { Failure::Temporary(error, None) })
            }
            404 | 410 => Err(Failure::Final(HubError::NotFound { url })),
            429 => {
                let retry_after_secs = header(&headers, "retry-after").and_then(|v| v.trim().parse().ok());
                let error = HubError::RateLimited { url, retry_after_secs };
                let wait = retry_after_secs.map(Duration::from_secs);
                Err(match wait.is_some_and(|w| w > self.settings.longest_wait) {
                    true => Failure::Final(error),
                    false => Failure::Temporary(error, wait),
                })
            }
            408 | 500.. => Err(Failure::Temporary(HubError::Status { url, status }, None)),
            _ => Err(Failure::Final(HubError::Status { url, status })),
        }
    }
}

/// Whether no connection was established: no network, an unknown host, or no server at the address.
fn is_connection_failure(error: &ureq::Error) -> bool {
    use std::io::ErrorKind as K;
    match error {
        ureq::Error::HostNotFound | ureq::Error::ConnectionFailed => true,
        // A failed name lookup has no error kind of its own, so errors of an established connection are excluded.
        ureq::Error::Io(e) => !matches!(
            e.kind(),
            K::ConnectionReset
                | K::ConnectionAborted
                | K::BrokenPipe
                | K::UnexpectedEof
                | K::TimedOut
                | K::WouldBlock
                | K::Interrupted
                | K::InvalidData
        ),
        _ => false,
    }
}

/// A header as text.
pub(crate) fn header<'h>(headers: &'h HeaderMap, name: &str) -> Option<&'h str> {
    headers.get(name).and_then(|value| value.to_str().ok())
}

fn gather(metadata: &mut FileMetadata, headers: &HeaderMap) {
    if let Some(bytes) = header(headers, "x-linked-size").and_then(|v| v.parse().ok()) {
        metadata.bytes.get_or_insert(bytes);
    }
    let hash = header(headers, "x-linked-etag").and_then(hash_of_etag);
    if let Some(hash) = hash {
        metadata.sha256.get_or_insert(hash);
    }
    if let Some(revision) = header(headers, "x-repo-commit").filter(|r| is_hex(r, 40)) {
        metadata.revision.get_or_insert(revision.to_ascii_lowercase());
    }
}

/// The SHA-256 in an entity tag, if it is one: `"…"` or `W/"…"`.
fn hash_of_etag(etag: &str) -> Option<String> {
    let inner = etag.trim().trim_start_matches("W/").trim_matches('"');
    is_hex(inner, 64).then(|| inner.to_ascii_lowercase())
}

fn is_hex(text: &str, length: usize) -> bool {
    text.len() == length && text.bytes().all(|b| b.is_ascii_hexdigit())
}

fn shortened(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).take(MOST_DETAIL).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_complete_hash_is_accepted() {
        let hash = "364492e38a3a06d221ac75da7f6621ada3f2361cd24fde11ba79091e9f40efcf";
        assert_eq!(hash_of_etag(&format!("\"{hash}\"")).as_deref(), Some(hash));
        assert_eq!(hash_of_etag(&format!("W/\"{}\"", hash.to_uppercase())).as_deref(), Some(hash));
        for not in ["", "\"\"", "\"abc\"", &hash[1..], &format!("{hash}0"), &"g".repeat(64)] {
            assert_eq!(hash_of_etag(not), None, "{not}");
        }
    }
}
