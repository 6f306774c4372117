//! Targets of redirects: the part of RFC 3986 that a `Location` header needs.

/// The parts of an `http` or `https` address that matter here.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Address {
    scheme: String,
    authority: String,
    /// Path and query, beginning with `/`.
    path: String,
}

impl Address {
    /// Parses an absolute address; `None` for anything but http and https with a host.
    pub fn parse(text: &str) -> Option<Self> {
        // Addresses that a browser would repair are refused: a hub does not send them.
        if !text.chars().all(|c| c.is_ascii_graphic() && c != '\\') {
            return None;
        }
        let (scheme, rest) = text.split_once("://")?;
        let scheme = scheme.to_ascii_lowercase();
        if scheme != "http" && scheme != "https" {
            return None;
        }
        let rest = rest.split('#').next()?;
        let end = rest.find(['/', '?']).unwrap_or(rest.len());
        let (authority, path) = rest.split_at(end);
        if authority.is_empty() || authority.contains('@') {
            return None;
        }
        let path = if path.starts_with('/') { path.to_owned() } else { format!("/{path}") };
        Some(Self { scheme, authority: authority.to_ascii_lowercase(), path })
    }

    /// The address of `location`, relative to this one.
    pub fn join(&self, location: &str) -> Option<Self> {
        if location.contains("://") && !location.starts_with(['/', '?']) {
            return Self::parse(location);
        }
        let base = format!("{}://{}", self.scheme, self.authority);
        let joined = match location {
            "" => return None,
            l if l.starts_with("//") => format!("{}:{l}", self.scheme),
            l if l.starts_with('/') => format!("{base}{l}"),
            l if l.starts_with('?') => format!("{base}{}{l}", self.path.split('?').next()?),
            l => {
                let folder = self.path.split('?').next()?.rsplit_once('/')?.0;
                format!("{base}{folder}/{l}")
            }
        };
        Self::parse(&joined)
    }

    /// Whether a token for `self` may be sent to `other`.
    pub fn same_origin(&self, other: &Self) -> bool {
        (&self.scheme, &self.authority) == (&other.scheme, &other.authority)
    }

    /// Whether going to `other` would give up encryption.
    pub fn is_downgrade(&self, other: &Self) -> bool {
        self.scheme == "https" && other.scheme == "http"
    }
}

impl std::fmt::Display for Address {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}://{}{}", self.scheme, self.authority, self.path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn locations_are_resolved_relative_to_their_address() {
        let here = Address::parse("https://Hub.example:8443/a/b/file?x=1#part").unwrap();
        let to = |location: &str| here.join(location).map(|a| a.to_string());
        assert_eq!(here.to_string(), "https://hub.example:8443/a/b/file?x=1");
        assert_eq!(to("https://cdn.example/x?y=://z").unwrap(), "https://cdn.example/x?y=://z");
        assert_eq!(to("//cdn.example/x").unwrap(), "https://cdn.example/x");
        assert_eq!(to("/c?d=http://e").unwrap(), "https://hub.example:8443/c?d=http://e");
        assert_eq!(to("other").unwrap(), "https://hub.example:8443/a/b/other");
        assert_eq!(to("?y=2").unwrap(), "https://hub.example:8443/a/b/file?y=2");
        for refused in
            ["", "ftp://x/y", "https://", "https://user@host/", "https://a b/", "\u{e9}", "http://\\"]
        {
            assert_eq!(to(refused), None, "{refused:?}");
        }
        let plain = Address::parse("http://hub.example:8443/").unwrap();
        assert!(here.is_downgrade(&plain) && !plain.is_downgrade(&here) && !here.same_origin(&plain));
    }

    proptest! {
        #[test]
        fn no_location_panics_and_every_result_can_be_parsed(location in ".{0,60}", tail in "[ -~]{0,40}") {
            let here = Address::parse("https://hub.example/a/b").unwrap();
            for text in [location.clone(), format!("//{tail}"), format!("http://{tail}"), tail.clone()] {
                if let Some(address) = here.join(&text) {
                    prop_assert_eq!(Address::parse(&address.to_string()), Some(address));
                }
            }
        }
    }
}
