"""Results as pages to be explored in a browser: `jaxbl explore DIR`, as a folder or served to this machine."""
