//! TLS with client certificates: the right one works, another one, and none, get no answer.
#![allow(clippy::unwrap_used, clippy::panic)]

mod common;

use common::{Brightness, chunk, facts, local, same_bits};
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::sync_channel;
use std::time::Duration;
use vidar_link::geometry::{DepthFormat, Expected, ImageFormat, RemoteModel, RemoteOptions};
use vidar_link::{Link, LinkError, LinkOptions, Role, Serving};

const KEY: &str = "lab/depth";

fn authority(name: &str) -> CertifiedIssuer<'static, KeyPair> {
    let mut params = CertificateParams::new(Vec::new()).unwrap();
    params.distinguished_name.push(rcgen::DnType::CommonName, name);
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap()
}

/// Writes key and certificate of `name`; the paths of both.
fn issue(folder: &Path, name: &str, by: &CertifiedIssuer<'_, KeyPair>) -> (PathBuf, PathBuf) {
    let key = KeyPair::generate().unwrap();
    let names = vec!["localhost".to_owned(), "127.0.0.1".to_owned()];
    let mut params = CertificateParams::new(names).unwrap();
    params.distinguished_name.push(rcgen::DnType::CommonName, name);
    let certificate = params.signed_by(&key, by).unwrap();
    let (key_file, file) = (folder.join(format!("{name}.key")), folder.join(format!("{name}.pem")));
    std::fs::write(&key_file, key.serialize_pem()).unwrap();
    std::fs::write(&file, certificate.pem()).unwrap();
    (key_file, file)
}

/// A file of settings as a user writes it.
fn settings(folder: &Path, name: &str, text: String) -> LinkOptions {
    let path = folder.join(format!("{name}.json5"));
    std::fs::write(&path, text).unwrap();
    LinkOptions { config: Some(path), ..LinkOptions::default() }
}

fn ask(options: &LinkOptions) -> Result<RemoteModel, LinkError> {
    let remote = RemoteOptions {
        settings: "{}".into(),
        expected: Expected::default(),
        images: ImageFormat::Raw,
        depth: DepthFormat::F32,
        timeout: Duration::from_secs(20),
        patience: Duration::from_secs(4),
        run: 1,
        rank: 0,
    };
    RemoteModel::open(Link::open(options, Role::Client)?.reach(KEY)?, remote, &|| false)
}

/// The file of settings of a worker that asks for certificates of an authority.
fn listens(
    folder: &Path,
    port: u16,
    ca: &Path,
    (key, certificate): &(PathBuf, PathBuf),
    more: &str,
) -> LinkOptions {
    let text = format!(
        "{{ listen: {{ endpoints: ['tls/127.0.0.1:{port}'] }}, {more} transport: {{ link: {{ tls: {{\n\
         enable_mtls: true, root_ca_certificate: {ca:?}, listen_private_key: {key:?}, listen_certificate: {certificate:?} }} }} }} }}"
    );
    settings(folder, "server", text)
}

/// That of an engine, with or without a certificate of its own.
fn connects(
    folder: &Path,
    name: &str,
    port: u16,
    ca: &Path,
    own: Option<&(PathBuf, PathBuf)>,
) -> LinkOptions {
    let own = own.map_or_else(String::new, |(key, certificate)| {
        format!(", enable_mtls: true, connect_private_key: {key:?}, connect_certificate: {certificate:?}")
    });
    let text = format!(
        "{{ connect: {{ endpoints: ['tls/localhost:{port}'] }}, transport: {{ link: {{ tls: {{ root_ca_certificate: {ca:?}{own} }} }} }} }}"
    );
    settings(folder, name, text)
}

fn require_refused(options: &LinkOptions) {
    match ask(options) {
        Err(LinkError::NoWorker { .. }) => {}
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("answered"),
    }
}

/// Runs `asks` beside a worker with these settings.
fn beside_a_worker(options: &LinkOptions, asks: impl FnOnce(&[String])) {
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let (sender, ready) = sync_channel(1);
        let serving = scope.spawn(|| {
            let served = Arc::new(Brightness(facts("bright")));
            let told = move |serving: Serving| {
                if let Serving::Ready { endpoints, .. } = serving {
                    sender.send(endpoints).unwrap();
                }
            };
            Link::open(options, Role::Server)?
                .serve(KEY, "test", served, &told, &|| stop.load(Ordering::SeqCst))
        });
        asks(&ready.recv_timeout(Duration::from_secs(20)).unwrap());
        stop.store(true, Ordering::SeqCst);
        serving.join().unwrap().unwrap();
    });
}

fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// A folder of this test's own.
fn folder_of(name: &str) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("vidar-{name}-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

#[test]
fn access_control_by_the_name_in_a_certificate_decides_who_may_ask() {
    let folder = folder_of("acl");
    let ours = authority("ours");
    let ca = folder.join("ours.ca");
    std::fs::write(&ca, ours.pem()).unwrap();
    let [server, robot, visitor] = ["server", "robot", "visitor"].map(|name| issue(&folder, name, &ours));
    let port = free_port();
    // As the guide has it.
    let control = "access_control: { enabled: true, default_permission: 'deny',\n\
         rules: [{ id: 'ask', permission: 'allow', key_exprs: ['lab/depth/**'],\n\
           messages: ['query', 'reply', 'declare_queryable', 'liveliness_token', 'declare_liveliness_subscriber', 'liveliness_query'] }],\n\
         subjects: [{ id: 'robots', cert_common_names: ['robot'] }],\n\
         policies: [{ rules: ['ask'], subjects: ['robots'] }] },";
    beside_a_worker(&listens(&folder, port, &ca, &server, control), |_| {
        let views = chunk(3);
        let mut model = ask(&connects(&folder, "robot", port, &ca, Some(&robot))).unwrap();
        let found = model.predict(&views, 0..4, true, &|_| false).unwrap();
        assert!(same_bits(&found, &local(&views, 0..4)));
        // Its certificate is of the right authority, but its name is not on the list.
        require_refused(&connects(&folder, "visitor", port, &ca, Some(&visitor)));
        let again = model.predict(&views, 0..4, true, &|_| false).unwrap();
        assert!(same_bits(&again, &local(&views, 0..4)), "who may ask still may");
    });
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn only_who_has_a_certificate_of_the_right_authority_is_answered() {
    let folder = folder_of("tls");
    let (ours, theirs) = (authority("ours"), authority("theirs"));
    let (our_ca, their_ca) = (folder.join("ours.ca"), folder.join("theirs.ca"));
    std::fs::write(&our_ca, ours.pem()).unwrap();
    std::fs::write(&their_ca, theirs.pem()).unwrap();
    let server = issue(&folder, "server", &ours);
    let client = issue(&folder, "client", &ours);
    let stranger = issue(&folder, "stranger", &theirs);
    let port = free_port();
    let of = |name: &str, ca: &Path, own| connects(&folder, name, port, ca, own);
    beside_a_worker(&listens(&folder, port, &our_ca, &server, ""), |endpoints| {
        assert_eq!(endpoints, [format!("tls/127.0.0.1:{port}")], "the file says where");
        let mut model = ask(&of("right", &our_ca, Some(&client))).unwrap();
        let views = chunk(3);
        let found = model.predict(&views, 0..4, true, &|_| false).unwrap();
        assert!(same_bits(&found, &local(&views, 0..4)));
        require_refused(&of("other authority", &our_ca, Some(&stranger)));
        require_refused(&of("no certificate", &our_ca, None));
        require_refused(&of("does not trust the server", &their_ca, Some(&client)));
        let plain = vec![format!("tcp/127.0.0.1:{port}")];
        require_refused(&LinkOptions { connect: plain, ..LinkOptions::default() });
        let again = model.predict(&views, 0..4, true, &|_| false).unwrap();
        assert!(same_bits(&again, &local(&views, 0..4)), "who was let in stays in");
    });
    std::fs::remove_dir_all(&folder).unwrap();
}
