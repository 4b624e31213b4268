//! What the data folder holds is read anew when the service starts; meanwhile it answers already, but for calls about
//! images.

use std::{
    fs, io,
    path::{Path, PathBuf},
    sync::Arc,
    time::{Instant, UNIX_EPOCH},
};

use axum::{
    extract::{Request, State},
    middleware::Next,
    response::Response,
};
use serde_json::Value;

use super::{
    Shared,
    entry::{Entry, Id, Opened, Slot},
    health::{Reason, recovering},
    problem::Refusal,
    regions,
    registry::{Images, now, remove},
    work::blocking,
};
use crate::{
    disk::Directory,
    image::{self, Image},
};

/// Recovers what was found in the data folder, one after another, and goes on with what can be filtered.
pub(super) async fn recover(service: Shared, found: Vec<PathBuf>) {
    recover_each(service, found, Images::recover).await;
}

/// Recovers each by `one`, which may panic.
async fn recover_each(service: Shared, found: Vec<PathBuf>, one: fn(&Images, &Path) -> Option<Opened>) {
    let (began, count) = (Instant::now(), found.len());
    for path in found {
        // It is all there at the next start too.
        if service.readiness.has(Reason::Draining) {
            return;
        }
        let (shared, place) = (Arc::clone(&service), path.clone());
        match blocking(move || one(&shared.images, &place)).await {
            Ok(Some(opened)) => regions::kick(&service, &opened),
            Ok(None) => {}
            // One that panics keeps no others from being recovered, and stays as it is.
            Err(refusal) => service.images.damaged(&path, &refusal.0.detail),
        }
    }
    service.readiness.set(Reason::Recovering, false);
    if count > 0 {
        tracing::info!(images = service.images.count(), seconds = began.elapsed().as_secs_f64(), "images recovered");
    }
}

/// Lets calls about images in once all are known.
pub(super) async fn recovered(
    State(service): State<Shared>,
    request: Request,
    next: Next,
) -> Result<Response, Refusal> {
    if service.readiness.has(Reason::Recovering) {
        return Err(recovering());
    }
    Ok(next.run(request).await)
}

impl Images {
    /// Opens the image that is there, and removes the remains of what was not finished. Gives the image if there is
    /// something to be filtered. Blocks.
    fn recover(&self, path: &Path) -> Option<Opened> {
        let Some(id) = path.file_name().and_then(|name| name.to_str()).and_then(Id::chosen) else {
            // An image that was just being made, or removed.
            if let Err(error) = remove(path) {
                tracing::error!(path = %path.display(), %error, "remains cannot be removed");
            }
            return None;
        };
        let touched =
            fs::metadata(path.join(image::TOUCHED)).or_else(|_| fs::metadata(path)).and_then(|m| m.modified());
        let touched =
            touched.ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok()).map_or_else(now, |t| t.as_secs());
        let opened = tidy(path).map_err(image::ImageError::from);
        let (owner, disk, slot) = match opened.and_then(|()| self.read(path)) {
            Ok(Err(error)) => {
                tracing::warn!(id = id.0, %error, "an image waits on the disk until somebody asks for it");
                let known = Image::describe(&Directory::new(path)).map(|known| (known.owner, known.disk));
                let (owner, disk) = known.unwrap_or_else(|_| (None, used(path)));
                (owner, disk, Slot::Closed(Value::Null))
            }
            Ok(Ok((image, memory))) => {
                let (description, summary) = (image.description().clone(), super::images::summary(&id, &image));
                // What can go on is kept open.
                let waits = image.read().regions().is_some_and(|regions| regions.open() > 0);
                let slot = if waits { Slot::Open(image, memory) } else { Slot::Closed(summary) };
                (description.owner, description.disk, slot)
            }
            Err(error) => {
                tracing::error!(id = id.0, %error, "an image cannot be opened");
                let damaged = error.is_damage();
                let slot = if damaged { Slot::Damaged(error.to_string()) } else { Slot::Closed(Value::Null) };
                (None, used(path), slot)
            }
        };
        let open = if let Slot::Open(image, memory) = &slot { Some((Arc::clone(image), memory.clone())) } else { None };
        let entry = Arc::new(Entry::new(id.clone(), owner, disk, touched, slot));
        self.lock().insert(id, Arc::clone(&entry));
        open.map(|(image, memory)| Opened { entry, image, memory })
    }

    /// Keeps the id of an image that could not even be looked at, so that nobody opens another one in its place.
    fn damaged(&self, path: &Path, why: &str) {
        if let Some(id) = path.file_name().and_then(|name| name.to_str()).and_then(Id::chosen) {
            let slot = Slot::Damaged(format!("{}: {why}", path.display()));
            self.lock().insert(id.clone(), Arc::new(Entry::new(id, None, used(path), now(), slot)));
        }
    }
}

/// Removes what does not belong into an image's folder.
fn tidy(path: &Path) -> io::Result<()> {
    for found in fs::read_dir(path)? {
        let found = found?;
        if found.file_name().to_str().is_none_or(|name| !image::FILES.contains(&name)) {
            remove(&found.path())?;
        }
    }
    Ok(())
}

/// Bytes of disk that the files of a folder take.
fn used(path: &Path) -> u64 {
    use std::os::unix::fs::MetadataExt;
    let files = fs::read_dir(path).into_iter().flatten().flatten();
    files.filter_map(|file| Some(file.metadata().ok()?.blocks() * 512)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{config::Config, filter::Method, image::Description, service::Service};

    /// Reads an image, unless it is this one.
    fn one(images: &Images, path: &Path) -> Option<Opened> {
        assert!(!path.ends_with("bad"), "on purpose");
        images.recover(path)
    }

    #[test]
    fn an_image_whose_recovery_panics_keeps_its_place_and_no_others() {
        let folder = tempfile::tempdir().unwrap();
        let description = Description::plain([64, 64], Method::default());
        for id in ["a", "bad", "c"] {
            let path = folder.path().join("images").join(id);
            fs::create_dir_all(&path).unwrap();
            Image::create(&Directory::new(&path), &description).unwrap();
        }
        let config = Config { data_dir: folder.path().into(), listen: ([127, 0, 0, 1], 0).into(), ..Config::default() };
        let Service { mut found, inner, .. } = Service::bind(config).unwrap();
        found.sort();
        assert!(inner.readiness.has(Reason::Recovering) && found.len() == 3);
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        runtime.block_on(recover_each(Arc::clone(&inner), found, one));
        assert!(!inner.readiness.has(Reason::Recovering));
        let list = inner.images.list();
        let told = |i: usize| (list[i]["id"].as_str().unwrap(), list[i]["damaged"].is_string());
        assert_eq!((list.len(), told(0), told(1), told(2)), (3, ("a", false), ("bad", true), ("c", false)));
        // It is what it was, for whoever looks into it, and nobody opens another one in its place.
        let bad = || Id::chosen("bad").unwrap();
        assert_eq!(inner.images.find(&bad()).unwrap_err().0.code, "damaged");
        let again = inner.images.open(bad(), description, usize::MAX);
        assert_eq!(again.unwrap_err().0.code, "damaged");
        assert!(Image::open(Box::new(Directory::new(folder.path().join("images/bad")))).is_ok());
        // It can be deleted.
        assert!(inner.images.delete(&bad()).unwrap() && inner.images.count() == 2);
    }
}
