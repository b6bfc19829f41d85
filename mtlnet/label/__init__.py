"""The page on which pictures are labelled by hand in the browser: `mtlnet label FOLDER`."""
