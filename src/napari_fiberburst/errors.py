"""The errors this package raises for input it cannot use: what was expected, what came, what to do."""


class FiberBurstError(ValueError):
    """Base of every error that a user can cause and mend."""


class BurstError(FiberBurstError):
    """The frames, or the file they come from, are not a usable burst."""


class BundleError(FiberBurstError):
    """A bundle, or the file or image it comes from, cannot be used, or does not fit the burst."""


class SettingsError(FiberBurstError):
    """A setting is unknown, out of range, or does not apply to the choice made."""


class DeviceError(FiberBurstError):
    """The computing device asked for is not on this machine."""


class MemoryLimitError(FiberBurstError):
    """A run takes more memory than there is, or than it may take."""


class OutputError(FiberBurstError):
    """A result cannot be written where it was asked to go, or a saved one cannot be read."""


class ClusterError(FiberBurstError):
    """Workers cannot be had as they were asked for, or were lost."""


class FullDiskError(OutputError):
    """There is no room for what was to be written."""
