// Fills the fields of objects from JSON by their names and passes over all other entries, as Unity's JsonUtility does.
using System;
using System.Collections.Generic;
using System.Globalization;
using System.Reflection;

class Json
{
    readonly string text;
    int at;

    public Json(string text) { this.text = text; }

    public object Read(Type type)
    {
        char first = Next();
        if (first == '{') return Record(type);
        if (first == '[') return List(type);
        if (first == '"') return Text();
        int start = at;
        while (at < text.Length && ",]} \n\r\t".IndexOf(text[at]) < 0) at++;
        string word = text.Substring(start, at - start);
        if (type == typeof(int)) return int.Parse(word, CultureInfo.InvariantCulture);
        return type == typeof(float) ? (object)float.Parse(word, CultureInfo.InvariantCulture) : null;
    }

    object Record(Type type)
    {
        object made = type == null ? null : Activator.CreateInstance(type, true);
        for (at++; Next() != '}';) {
            string name = Text();
            if (Next() == ':') at++;
            var flags = BindingFlags.Instance | BindingFlags.Public | BindingFlags.NonPublic;
            FieldInfo field = type == null ? null : type.GetField(name, flags);
            object value = Read(field == null ? null : field.FieldType);
            if (field != null) field.SetValue(made, value);
            if (Next() == ',') at++;
        }
        at++;
        return made;
    }

    object List(Type type)
    {
        Type kind = type == null ? null : type.GetElementType();
        var read = new List<object>();
        for (at++; Next() != ']';) {
            read.Add(Read(kind));
            if (Next() == ',') at++;
        }
        at++;
        if (kind == null) return null;
        Array made = Array.CreateInstance(kind, read.Count);
        for (int i = 0; i < read.Count; i++) made.SetValue(read[i], i);
        return made;
    }

    string Text()
    {
        int start = ++at;
        while (text[at] != '"') at += text[at] == '\\' ? 2 : 1;
        return text.Substring(start, at++ - start);
    }

    char Next()
    {
        while (char.IsWhiteSpace(text[at])) at++;
        return text[at];
    }
}
