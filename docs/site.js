/* Browsers run no search in pages that are read from the disk, so these don't offer it. */
document.documentElement.classList.toggle("from-disk", location.protocol === "file:");
