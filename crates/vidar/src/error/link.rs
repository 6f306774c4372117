//! Errors between machines.

use vidar_link::LinkError as L;

/// The code of an error between machines.
pub(super) fn code(error: &L) -> &'static str {
    match error {
        L::BadSetting { .. } => "E0105",
        L::File { .. } => "E0401",
        L::NoWorker { .. } => "E0409",
        L::OtherModel { .. } => "E0410",
        L::Cancelled => "E1301",
        _ => "E0408",
    }
}

/// The hint for an error between machines.
pub(super) fn hint(error: &L) -> &'static str {
    match error {
        L::NotBuilt => "build the program with `--features link`",
        L::BadSetting { .. } => {
            "endpoints are like tcp/192.168.1.5:7447; keys like vidar/geometry, without * and spaces; --link-config takes a file like \
             Zenoh's DEFAULT_CONFIG.json5"
        }
        L::NoWorker { .. } => {
            "start `vidar worker --model da3-small` there; --connect names its endpoint; with TLS, a certificate that is not \
             accepted looks the same"
        }
        L::OtherModel { .. } => {
            "remote.model names the model that workers must have; give each of them the same"
        }
        _ => "check the address, whether the port is free, and --link-config",
    }
}
