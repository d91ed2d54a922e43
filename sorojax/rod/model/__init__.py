"""Model of a rod or an assembly: strain bases, sections, links, joints."""
