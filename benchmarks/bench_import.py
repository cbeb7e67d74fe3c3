"""What `import hyperpaint` costs beside the `import xarray` that no accessor can do without."""


class Import:
    def timeraw_floor(self):
        return "import xarray"

    def timeraw_hyperpaint(self):
        return "import hyperpaint"
