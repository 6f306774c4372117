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
    };
    RemoteModel::open(Link::open(options, Role::Client)?.reach(KEY)?, remote, &|| false)
}

#[test]
fn only_who_has_a_certificate_of_the_right_authority_is_answered() {
    let folder = std::env::temp_dir().join(format!("vidar-tls-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let (ours, theirs) = (authority("ours"), authority("theirs"));
    let (our_ca, their_ca) = (folder.join("ours.ca"), folder.join("theirs.ca"));
    std::fs::write(&our_ca, ours.pem()).unwrap();
    std::fs::write(&their_ca, theirs.pem()).unwrap();
    let server = issue(&folder, "server", &ours);
    let client = issue(&folder, "client", &ours);
    let stranger = issue(&folder, "stranger", &theirs);
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let at = format!("tls/localhost:{port}");
    let listens = settings(
        &folder,
        "server",
        format!(
            "{{ listen: {{ endpoints: ['tls/127.0.0.1:{port}'] }}, transport: {{ link: {{ tls: {{\n\
             enable_mtls: true, root_ca_certificate: {our_ca:?}, listen_private_key: {:?}, listen_certificate: {:?} }} }} }} }}",
            server.0, server.1
        ),
    );
    let connects = |name: &str, ca: &Path, own: Option<&(PathBuf, PathBuf)>| {
        let own = own.map_or_else(String::new, |(key, certificate)| {
            format!(", enable_mtls: true, connect_private_key: {key:?}, connect_certificate: {certificate:?}")
        });
        let text = format!(
            "{{ connect: {{ endpoints: ['{at}'] }}, transport: {{ link: {{ tls: {{ root_ca_certificate: {ca:?}{own} }} }} }} }}"
        );
        settings(&folder, name, text)
    };
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
            Link::open(&listens, Role::Server)?
                .serve(KEY, "test", served, &told, &|| stop.load(Ordering::SeqCst))
        });
        let endpoints = ready.recv_timeout(Duration::from_secs(20)).unwrap();
        assert_eq!(endpoints, [format!("tls/127.0.0.1:{port}")], "the file says where");
        let mut model = ask(&connects("right", &our_ca, Some(&client))).unwrap();
        let views = chunk(3);
        let found = model.predict(&views, 0..4, true, &|_| false).unwrap();
        assert!(same_bits(&found, &local(&views, 0..4)));
        let refused = |options: &LinkOptions| match ask(options) {
            Err(LinkError::NoWorker { .. }) => {}
            Err(other) => panic!("{other}"),
            Ok(_) => panic!("answered"),
        };
        refused(&connects("other authority", &our_ca, Some(&stranger)));
        refused(&connects("no certificate", &our_ca, None));
        refused(&connects("does not trust the server", &their_ca, Some(&client)));
        refused(&LinkOptions { connect: vec![format!("tcp/127.0.0.1:{port}")], ..LinkOptions::default() });
        let again = model.predict(&views, 0..4, true, &|_| false).unwrap();
        assert!(same_bits(&again, &local(&views, 0..4)), "who was let in stays in");
        stop.store(true, Ordering::SeqCst);
        serving.join().unwrap().unwrap();
    });
    std::fs::remove_dir_all(&folder).unwrap();
}
